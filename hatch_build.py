"""Build hook: make the library of the estimator, for this machine or a wheel's, and take the firmware along.

``CC`` names the C compiler and ``SKYLESS_TARGET`` the other machine; ``tools/compile_core.py`` says more.
"""

import os
import sys
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

sys.path.insert(0, str(Path(__file__).parent / "tools"))
from compile_core import NATIVE, TARGETS, ZIG, build, compiler, target


class CoreBuildHook(BuildHookInterface):  # type: ignore[type-arg]
    """Makes the library before the wheel, or the editable installation, is put together."""

    def dependencies(self) -> list[str]:
        """A compiler, where this machine has none."""
        return [] if compiler() else [ZIG]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and name the platform that the wheel is for."""
        if os.environ.get("SKYLESS_TARGET"):
            platform = TARGETS[target()][1]
        else:
            platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{platform}"
        libraries = build(Path(self.root) / NATIVE)
        build_data["artifacts"] += [f"/{library.relative_to(self.root)}" for library in libraries]
        image = Path(self.root) / "firmware" / "build" / "skyless-dwm1001.hex"
        if version == "standard" and image.is_file():  # an editable installation takes it where it is built
            build_data["force_include"][str(image)] = "skyless/radio/serial/skyless-dwm1001.hex"
