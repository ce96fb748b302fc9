"""Results of a study's finished cells in a folder, from which a later call goes on.

Each is a file of its own, which is there whole or not at all, and begins with a digest of the study and of itself.
They are pickles of Python: a folder of somebody else can run any program.
"""

import pickle
from hashlib import sha256
from pathlib import Path
from typing import Any

import msgspec

from skyless.core.errors import SkylessError
from skyless.core.version import installed_version, program_digest
from skyless.core.whole_files import write_whole
from skyless.research.studies.common.plan import Plan


class KeptResults:
    """The folder of one study."""

    def __init__(self, folder: str | Path, study: str, plan: Plan) -> None:
        """Raises SkylessError: the folder cannot be used, or is of another study, plan or program."""
        self._folder = folder = Path(folder)
        program = {"version": installed_version(), "source digest": program_digest()}
        asked = {"study": study, **msgspec.to_builtins(plan), **program}
        self._head = msgspec.json.encode(asked)
        head = folder / "study.json"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            there = msgspec.json.decode(head.read_bytes(), type=dict[str, Any]) if head.exists() else asked
        except OSError as error:
            raise SkylessError(f"--resume is {str(folder)!r}, which cannot be used: {error.strerror}") from None
        except (msgspec.MsgspecError, UnicodeError):
            raise SkylessError(f"--resume: {head} is damaged; give another folder") from None
        for name, value in asked.items():
            if there.get(name) != value:
                raise SkylessError(
                    f"--resume is {str(folder)!r}, of another study: {name} is {there.get(name)!r} there, "
                    f"{value!r} here; give another folder"
                )
        self._write(head, self._head)

    def read(self, cells: int) -> tuple[dict[int, Any], tuple[str, ...]]:
        """The results that are there, by the numbers of their cells; and the files that are damaged."""
        results, damaged = {}, []
        for number in range(cells):
            file = self._file(number)
            try:
                read = file.read_bytes()
            except OSError:
                continue
            digest, data = read[:32], read[32:]
            if digest == self._digest(data):
                results[number] = pickle.loads(data)
            else:
                damaged.append(str(file))
        return results, tuple(damaged)

    def keep(self, number: int, result: object) -> None:
        """Write the result of a cell. Raises SkylessError."""
        data = pickle.dumps(result)
        self._write(self._file(number), self._digest(data) + data)

    def _file(self, number: int) -> Path:
        return self._folder / f"{number:05}.part"

    def _digest(self, data: bytes) -> bytes:
        return sha256(self._head + data).digest()

    def _write(self, file: Path, data: bytes) -> None:
        try:
            write_whole(file, data)
        except OSError as error:
            raise SkylessError(f"--resume: {file} cannot be written: {error.strerror}") from None
