"""Open rendered scenes as a checkpoint sees them, for programs that run its method themselves."""

from pathlib import Path
from typing import Any

from programs import HOME

from posefilter.cli.build import build_data
from posefilter.cli.command import compose_job
from posefilter.cli.evaluate import data_settings
from posefilter.data.module import PoseDataModule


def open_frames(file: str, checkpoint: dict[str, Any], name: str, options: Any) -> PoseDataModule:
    """Return the frames of a folder of scenes that show an object, as its checkpoint sees them.

    Args:
        file: The checkpoint's.
        checkpoint: Its content.
        name: The object.
        options: `root` and `meshes` of the scenes; `frames`, at most.
    """
    words = [f"checkpoint={file}", "data=fat", f"data.root={options.root}"]
    words += [f"data.meshes={options.meshes}", f"data.object={name}", "data.split={val: 1.0}"]
    words += ["data.min_visibility_test=0.1", "data.workers=0"]
    job = compose_job("calibrate", HOME / "conf", words, Path())
    settings = data_settings(job, checkpoint["recipe"]["settings"], name, "val")
    settings.limit_val = options.frames
    data = build_data(settings, "json")
    data.setup("validate")
    return data
