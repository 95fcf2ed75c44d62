"""Give weights files surface points of their mesh, where they carry few.

    python bench/surface_points.py --meshes DIR [--count 2000] FILE.ckpt [FILE.ckpt ...]

The points are drawn uniformly, by seed 0, as training draws them. They are what the alignment with
the measured depth (`filters/icp.py`) lays on it, and what ADD is of; no network is changed.
"""

from pathlib import Path

from programs import make_parser

from posefilter.cli.checkpoints import read_checkpoint
from posefilter.cli.files import pack_whole
from posefilter.data.readers.registry import open_meshes
from posefilter.files import write_whole
from posefilter.meshes.mesh import object_model
from posefilter.models.quantization import pack_object


def give_points(file: Path, meshes: str, count: int) -> int:
    """Write a file with so many surface points; return how many it had."""
    checkpoint = read_checkpoint(file)
    own = checkpoint["object_model"]
    mesh = open_meshes(meshes, None, "fat", [own["name"]]).load(own["name"])
    had, own["points"] = len(own["points"]), object_model(mesh, count=count).points
    checkpoint["object_model"] = pack_object(own)
    write_whole(file, pack_whole(checkpoint), sync=True)
    return had


def main() -> None:
    """Write each file, and say so."""
    parser = make_parser(__doc__)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--meshes", required=True, help="a folder of YCB's meshes")
    parser.add_argument("--count", type=int, default=2000)
    given = parser.parse_args()
    for file in given.files:
        print(f"{file}: {give_points(file, given.meshes, given.count)} -> {given.count} points")


if __name__ == "__main__":
    main()
