"""Put the configuration and the weights that ship into the wheel; all the rest is in
pyproject.toml.

An editable install reads them where they are, at the top of the clone.
"""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

SHIPPED = {"conf": "**/*.yaml", "weights": "*.ckpt"}


class BuildWithFiles(build_py):
    """Copy the top-level folders into the package that is built."""

    def run(self) -> None:
        """Build the modules, then copy."""
        super().run()
        if self.editable_mode:
            return
        package = Path(self.build_lib) / "posefilter"
        for folder, pattern in SHIPPED.items():
            shutil.rmtree(package / folder, ignore_errors=True)
            for file in sorted(Path(folder).glob(pattern)):
                target = package / file
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, target)


setup(cmdclass={"build_py": BuildWithFiles})
