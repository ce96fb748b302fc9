"""What a tag remembers of a site's keys for its next start: certificates, and the highest serial number that it saw."""

from collections.abc import Iterable
from hashlib import sha256
from pathlib import Path

import msgspec
from msgspec import Struct

from skyless.air.codec2 import CERTIFICATE_BYTES
from skyless.authentication.key_files import MOST_SERIAL
from skyless.trusted_receiver import SiteTrust
from skyless.whole_files import write_whole

_MOST_BYTES = 1 << 16


class Remembered(Struct, frozen=True):
    """What the file holds. Signatures are checked again when it is used."""

    serial: int = 0
    """Key chains with lower serial numbers have been revoked."""
    certificates: tuple[bytes, ...] = ()


class TagMemory:
    """The file of one site and public key. One that is damaged or cannot be written is as good as none."""

    def __init__(self, trust: SiteTrust, folder: Path) -> None:
        """``folder``: the user's data folder of Skyless."""
        key = sha256(trust.public).hexdigest()[:16]
        self.file = folder / "trust" / f"{trust.site}-{key}.json"
        self.remembered = self._read()

    def keep(self, serial: int, certificates: Iterable[bytes]) -> None:
        """Write what is known now, if it is something else; the serial number never becomes lower."""
        known = Remembered(serial, tuple(certificates))
        if known == self.remembered:
            return
        others = self._read()
        known = Remembered(max(serial, others.serial), known.certificates or others.certificates)
        self.remembered = Remembered(serial, tuple(certificates))
        if known == others:
            return
        try:
            self.file.parent.mkdir(exist_ok=True)
            write_whole(self.file, msgspec.json.encode(known))
        except OSError:
            return

    def _read(self) -> Remembered:
        try:
            with self.file.open("rb") as file:
                read = msgspec.json.decode(file.read(_MOST_BYTES), type=Remembered)
        except (OSError, msgspec.MsgspecError):
            return Remembered()
        if not 0 <= read.serial <= MOST_SERIAL or any(len(one) != CERTIFICATE_BYTES for one in read.certificates):
            return Remembered()
        return read
