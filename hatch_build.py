"""Wheels carry the compiled functions as bitcode, so that a first start compiles nothing."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

COMPILES = ("numba", "numpy", "scipy", "pydantic", "pymavlink", "fastcrc", "pyyaml", "daqp")


class BitcodeHook(BuildHookInterface[Any]):
    """Runs `offboard.model.wheel` for a wheel; an editable installation compiles when it flies,
    and needs no compiler for that (pip says what it wants a build for)."""

    def dependencies(self) -> list[str]:
        if "get_requires_for_build_editable" in sys.argv:
            return []
        return [each for each in self.metadata.core.dependencies if each.startswith(COMPILES)]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if version == "editable":
            return
        self._made = tempfile.TemporaryDirectory()
        found = os.pathsep.join([self.root, *sys.path])  # pip builds with a path of its own
        subprocess.run(
            [sys.executable, "-m", "offboard.model.wheel", self._made.name],
            cwd=self.root,
            env={**os.environ, "PYTHONPATH": found, "NUMBA_CPU_NAME": "generic"},
            check=True,
        )
        build_data["force_include"][self._made.name] = "offboard/_bitcode"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        if version != "editable":
            self._made.cleanup()
