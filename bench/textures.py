"""Give weights files the texture of their mesh, and the refinement that uses it.

    python bench/textures.py --meshes DIR FILE.ckpt [FILE.ckpt ...]

No network is changed. A calibration is of the filter before, and is taken out: calibrate the files
again.
"""

import argparse
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from posefilter.cli.checkpoints import read_checkpoint
from posefilter.cli.files import pack_whole
from posefilter.data.readers.registry import open_meshes
from posefilter.files import write_whole
from posefilter.meshes.texture import add_texture
from posefilter.models.quantization import pack_object, unpack_object

TURNS = "posefilter.filters.texture.TextureRotations"
REFINE = Path(__file__).parents[1] / "conf/filter/refine/mean_shift_icp_texture.yaml"


def insert_turns(components: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a refinement's components, with the turns before the last, which scores anew."""
    known: Any = OmegaConf.to_container(OmegaConf.load(REFINE))
    turns = next(one for one in known["components"] if one["_target_"] == TURNS)
    kept = [one for one in components if one["_target_"] != TURNS]
    return [*kept[:-1], turns, kept[-1]]


def give_texture(file: Path, meshes: str) -> int:
    """Write a file with its object's texture; return how many turns its shape leaves open."""
    checkpoint = read_checkpoint(file)
    own = checkpoint["object_model"]
    mesh = open_meshes(meshes, None, "fat", [own["name"]]).load(own["name"])
    object_model = add_texture(unpack_object(own), mesh)
    assert object_model.shape_symmetries is not None
    checkpoint["object_model"] = pack_object(object_model._asdict())
    refine = checkpoint["recipe"]["settings"]["filter"]["refine"]
    refine["components"] = insert_turns(refine["components"])
    checkpoint["recipe"]["choices"]["filter/refine"] = REFINE.stem
    checkpoint.pop("calibration", None)
    write_whole(file, pack_whole(checkpoint), sync=True)
    return len(object_model.shape_symmetries)


def main() -> None:
    """Write each file, and say so."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--meshes", required=True, help="a folder of YCB's meshes")
    given = parser.parse_args()
    for file in given.files:
        print(f"{file}: {give_texture(file, given.meshes)} turns of its shape")


if __name__ == "__main__":
    main()
