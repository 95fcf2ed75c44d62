"""Give weights files the texture of their mesh, and the refinement that uses it.

    python bench/textures.py --meshes DIR [--align] [--points 3200] [--out DIR]
        FILE.ckpt [FILE.ckpt ...]

With --align the estimate is laid on the print as well (filters/texture_alignment.py), which takes
more textured points.  No network is changed. A calibration is of the filter before, and is taken
out: calibrate the files again.  Without --out the files themselves are changed.
"""

from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from programs import HOME, make_parser

from posefilter.cli.checkpoints import read_checkpoint
from posefilter.cli.files import pack_whole
from posefilter.data.readers.registry import open_meshes
from posefilter.files import write_whole
from posefilter.meshes.texture import TEXTURE_POINTS, add_texture
from posefilter.models.quantization import pack_object, unpack_object

TURNS, ALIGNMENT = (
    f"posefilter.filters.{name}"
    for name in ("texture.TextureRotations", "texture_alignment.TextureAlignment")
)
REFINE = HOME / "conf/filter/refine"


def insert(components: list[dict[str, Any]], choice: str) -> list[dict[str, Any]]:
    """Return a refinement's components, with those by texture of a choice of `filter/refine` before
    the last, which scores anew.
    """
    known: Any = OmegaConf.to_container(OmegaConf.load(REFINE / f"{choice}.yaml"))
    own = [one for one in known["components"] if one["_target_"] in (TURNS, ALIGNMENT)]
    kept = [one for one in components if one["_target_"] not in (TURNS, ALIGNMENT)]
    return [*kept[:-1], *own, kept[-1]]


def give_texture(file: Path, meshes: str, align: bool, points: int, out: Path) -> int:
    """Write a file with its object's texture; return how many turns its shape leaves open."""
    checkpoint = read_checkpoint(file)
    own = checkpoint["object_model"]
    mesh = open_meshes(meshes, None, "fat", [own["name"]]).load(own["name"])
    object_model = add_texture(unpack_object(own), mesh, points)
    assert object_model.shape_symmetries is not None
    checkpoint["object_model"] = pack_object(object_model._asdict())
    refine = checkpoint["recipe"]["settings"]["filter"]["refine"]
    choice = f"mean_shift_icp_texture{'_alignment' if align else ''}"
    refine["components"] = insert(refine["components"], choice)
    checkpoint["recipe"]["choices"]["filter/refine"] = choice
    checkpoint.pop("calibration", None)
    out.mkdir(parents=True, exist_ok=True)
    write_whole(out / file.name, pack_whole(checkpoint), sync=True)
    return len(object_model.shape_symmetries)


def main() -> None:
    """Write each file, and say so."""
    parser = make_parser(__doc__)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--meshes", required=True, help="a folder of YCB's meshes")
    parser.add_argument("--align", action="store_true", help="lay the estimate on the print, too")
    parser.add_argument("--points", type=int, default=TEXTURE_POINTS)
    parser.add_argument("--out", type=Path, help="a folder for the files; none: where they are")
    given = parser.parse_args()
    for file in given.files:
        out = given.out or file.parent
        turns = give_texture(file, given.meshes, given.align, given.points, out)
        print(f"{out / file.name}: {turns} turns of its shape")


if __name__ == "__main__":
    main()
