"""Make the pictures of README.md and docs/ from real runs: `make pictures`, never by hand.

    python docs/make_pictures.py [--checkpoint weights/NAME.ckpt] [--scenes DIR]
        [--meshes builtin|DIR] [--tour outputs/tour]
                                 [--methods outputs/methods]

Of a checkpoint: what it finds in rendered scenes that no training saw, its belief about one, and
its particles' way there.  Of docs/tour.md's commands, and of the runs of docs/results, where they
were made: what they left.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from convergence import animate_convergence, encode_webp
from PIL import Image

from posefilter.cli.build import quiet
from posefilter.cli.checkpoints import method_of, read_checkpoint
from posefilter.cli.machine import settle
from posefilter.data.frames import Sample
from posefilter.data.readers.registry import open_reader
from posefilter.errors import UserError
from posefilter.figures.belief import draw_belief
from posefilter.figures.canvas import ESTIMATE, TRUTH, arrange_grid, draw_row, full_view
from posefilter.figures.layout import TITLE, draw_text
from posefilter.figures.overlay import Shape, draw_poses, list_axes
from posefilter.figures.particles import draw_iterations
from posefilter.images import Images, make_batch
from posefilter.meshes.store import MeshStore
from posefilter.metrics.errors import add
from posefilter.models.base import PoseEstimator
from posefilter.report.charts import LIGHT, Line, Panel, draw_chart
from posefilter.report.sweeps import read_sweep
from posefilter.synthetic.generate import generate
from posefilter.types import Batch, Trace

HOME = Path(__file__).parents[1]
# of the rendered scenes: a seed that no training uses, and a scene a frame
SEED, FRAMES = 20_000_101, 6
EXAMPLE = 3  # which of them belief and particles are drawn of
BRIGHT = 3  # which of them is animated: well lit, and nothing stands before the object
# the search that is animated: it begins anywhere on the measured surfaces rather than where the
# network proposes
SEARCH = {
    "filter": {
        "initialize": {
            "_target_": "posefilter.filters.initialize.FromDepth",
            "depth_offset": [0.1, 0.9],
        },
        "steps": 20,
        "initial_particles": 3000,
    },
}
WIDTH, QUALITY = 1400, 82  # of the written pictures: [px] at most, and of JPEG
TOUR = {  # what docs/tour.md shows -> what its commands leave
    "tour_scenes": "scenes/preview.png",
    "tour_check": "check/contact_sheet.png",
    "tour_train": "run/figures/validation_overlays.jpg",
    "tour_predict": "prediction/belief.png",
}
# the ablations that its picture shows, and what to say of each
ABLATIONS = {
    "paper": "Paper",
    "c5_displacement_loss": "Loss on the displacement",
    "c6_position": "Position detached, too",
    "c9_context": "Features of the whole image, too",
}
# those with a pose first: each has one color in all charts
METHODS = ("patch_pf", "pixel_pf", "cnn_patch", "downsized")
# of a filter, swept when it is tested; its table
SIZES = {"filter.particles": "particles", "filter.steps": "iterations"}
FIGURES = {  # of these sweeps: title, unit, and by what to multiply; None: of one over the least
    "particles_on_object": ("Particles on the object", "%", 100),
    "add/auc": ("ADD AUC", "", 1),
    "seconds_per_image": ("Time per image", "relative to the shortest", None),
}
BROWSER = next(
    (
        found
        for name in ("chromium", "chromium-browser", "google-chrome")
        if (found := shutil.which(name))
    ),
    None,
)


class Found(NamedTuple):
    """What the filter made of one frame."""

    sample: Sample
    batch: Batch
    trace: Trace


def main() -> int:
    """Make all that can be made; say what was left as it is, and why."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--checkpoint", type=Path, default=HOME / "weights" / "003_cracker_box.ckpt"
    )
    parser.add_argument(
        "--scenes",
        type=Path,
        help="rendered frames in the FAT format (default: docs/scenes/<object>)",
    )
    parser.add_argument(
        "--meshes", default="builtin", help="to render scenes from, where there are none yet"
    )
    parser.add_argument(
        "--tour",
        type=Path,
        default=Path("outputs/tour"),
        help="where docs/tour.md's commands wrote",
    )
    parser.add_argument(
        "--methods", type=Path, default=Path("outputs/methods"), help="where bench/methods.py wrote"
    )
    parser.add_argument("--out", type=Path, default=HOME / "docs" / "pictures")
    options = parser.parse_args()
    try:
        of_checkpoint(options.checkpoint, options.scenes, options.meshes, options.out)
        of_tour(options.tour, options.out)
        of_ablations(options.methods / "ablation" / "patch_pf", options.out)
        of_filters(options.methods, options.out)
    except UserError as error:
        print(f"make_pictures: {error}", file=sys.stderr)
        return 2
    return 0


def of_checkpoint(checkpoint: Path, scenes: Path | None, meshes: str, out: Path) -> None:
    """Write predictions.jpg, belief.jpg, particles.jpg and convergence.webp."""
    quiet()
    settle(None, 0)
    kept = read_checkpoint(checkpoint)
    method = method_of(kept)
    name = method.object_model.name
    scenes = scenes or HOME / "docs" / "scenes" / name
    if not scenes.is_dir():
        generate(
            scenes,
            FRAMES,
            meshes=meshes,
            object=name,
            seed=SEED,
            size=(320, 240),
            frames_per_scene=1,
            workers=1,
        )
    store = MeshStore(meshes)
    shape: Shape = store.load(name) if name in store.names() else method.object_model.hull
    found = list(run(method, kept["recipe"]["settings"]["data"], scenes, name))
    write(out / "predictions.jpg", predictions(found, method, shape))
    one = found[min(EXAMPLE, len(found) - 1)]
    sample, K = one.sample, one.sample.intrinsics
    write(
        out / "belief.jpg",
        draw_belief(
            sample.rgb, K, one.trace.belief, method.object_model, sample.camera_from_object
        ),
    )
    write(out / "particles.jpg", draw_iterations(sample.rgb, K, one.trace, method.space))
    searching = method_of(kept, SEARCH)
    sample, _, trace = next(
        run(searching, kept["recipe"]["settings"]["data"], scenes, name, only=BRIGHT)
    )
    object_model = method.object_model
    frames = animate_convergence(
        sample.rgb,
        sample.intrinsics,
        trace,
        object_model.center,
        object_model.hull,
        object_model.hull,
        between=5,
    )
    path = out / "convergence.webp"
    path.write_bytes(encode_webp(list(frames)))
    print(f"{path} ({path.stat().st_size / 1000:.0f} kB)")


def run(
    method: PoseEstimator, data: dict, scenes: Path, name: str, only: int | None = None
) -> Iterator[Found]:
    """Yield what the filter makes of each frame of a folder of scenes; the frames are of the size
    that it was trained on.

    only: which of the frames, the last one where there are fewer (None: all).
    """
    reader = open_reader("scenes", scenes, name)
    count = len(reader.records())
    for i in range(count) if only is None else [min(only, count - 1)]:
        sample = reader.read(i)
        width = data.get("image_width") or sample.rgb.shape[1]
        if sample.rgb.shape[1] != width:
            raise UserError(
                f"{scenes}: frames are {sample.rgb.shape[1]} pixels wide, but the "
                f"filter takes {width}"
            )
        one = Images(sample.rgb[None], sample.depth[None], sample.intrinsics[None].astype(float))
        batch = make_batch(one, None, None)
        method.seed = 0
        with torch.no_grad():
            yield Found(sample, batch, method.predict_step(batch, 0))


def predictions(found: list[Found], method: PoseEstimator, shape: Shape) -> np.ndarray:
    """Draw estimate and truth in every frame, with the error; none is left out."""
    tiles = []
    for sample, _, trace in found:
        height, width = sample.mask.shape
        truth = torch.from_numpy(sample.camera_from_object)[None]
        error = 1000 * float(add(trace.belief.best, truth, method.object_model.points)[0])
        view = full_view(height, width, 460)
        pose = trace.belief.best[0].double().numpy()
        drawn = draw_poses(
            sample.rgb, sample.intrinsics, pose, shape, view, truth=sample.camera_from_object
        )
        tiles.append(np.concatenate([drawn, draw_row(460, f"ADD {error:.1f} mm")]))
    figure = arrange_grid(tiles, 3)
    legend = [("truth", TRUTH), ("estimate", ESTIMATE), *list_axes()]
    return np.concatenate(
        [
            draw_row(
                figure.shape[1],
                f"{method.object_model.name}: {len(found)} held-out scenes",
                legend,
            ),
            figure,
        ]
    )


def of_tour(tour: Path, out: Path) -> None:
    """Write what the tour's commands left; a report's first screen needs a Chromium."""
    for name, source in TOUR.items():
        if (tour / source).is_file():
            write(out / f"{name}.jpg", np.asarray(Image.open(tour / source).convert("RGB")))
        else:
            print(
                f"left as it is: {name}.jpg (no {tour / source}: run the commands of "
                f"docs/tour.md, or make tour)"
            )
    page = tour / "run" / "report" / "report.html"
    if BROWSER is None or not page.is_file():
        reason = f"no {page}" if BROWSER else "no Chromium is installed"
        print(f"left as it is: tour_report.jpg ({reason})")
    else:
        write(
            out / "tour_report.jpg",
            np.concatenate([screen(page, dark=False), screen(page, dark=True)], axis=1),
        )


def of_ablations(runs: Path, out: Path) -> None:
    """Write trajectories.jpg: where particles go on one image, at the ablations that explain it."""
    tiles = []
    for name, words in ABLATIONS.items():
        found = sorted(runs.glob(f"*ablation={name},*/figures/test_trajectories_0.jpg"))
        if len(found) != 1:
            count = f"{len(found)} runs of ablation={name} in {runs}, not one"
            print(f"left as it is: trajectories.jpg ({count})")
            return
        picture = np.asarray(Image.open(found[0]).convert("RGB"))
        tiles.append(np.concatenate([draw_text(words, TITLE - 4, bold=True), picture]))
    write(out / "trajectories.jpg", arrange_grid(tiles, 2))


def of_filters(methods: Path, out: Path) -> None:
    """Write filters.jpg: quality and cost over the filter's size, a row a setting, a line a
    method.
    """
    tiles = []
    for axis, table in SIZES.items():
        found = {
            name: read_sweep(methods / table / name).jobs
            for name in METHODS
            if (methods / table / name).is_dir()
        }
        if not found:
            print(f"left as it is: filters.jpg (no {methods / table})")
            return
        for name, (title, unit, factor) in FIGURES.items():
            have = {
                model: [job for job in jobs if name in job.numbers] for model, jobs in found.items()
            }
            by = factor or 1 / min(job.numbers[name] for jobs in have.values() for job in jobs)
            lines = [
                Line(
                    model,
                    [float(job.place[axis]) for job in jobs],
                    [by * job.numbers[name] for job in jobs],
                )
                for model, jobs in have.items()
                if jobs
            ]
            chart = draw_chart(Panel(title, table, unit, lines, log_x=True), LIGHT)
            tiles.append(np.asarray(Image.open(BytesIO(chart)).convert("RGB")))
    write(out / "filters.jpg", arrange_grid(tiles, len(FIGURES)))


def screen(page: Path, dark: bool) -> np.ndarray:
    """Return a page's first screen as a browser shows it."""
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder) / "shot.png"
        command = [
            str(BROWSER),
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-quic",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--hide-scrollbars",
            f"--user-data-dir={folder}/profile",
            f"--screenshot={shot}",
            "--window-size=900,1100",
            *(["--blink-settings=preferredColorScheme=0"] if dark else []),
            page.resolve().as_uri(),
        ]
        subprocess.run(command, check=True, capture_output=True, timeout=300)
        return np.asarray(Image.open(shot).convert("RGB"))


def write(path: Path, content: np.ndarray) -> None:
    """Write a JPEG, made smaller where it is wide."""
    image = Image.fromarray(content)
    image.thumbnail((WIDTH, 4 * WIDTH), Image.Resampling.LANCZOS)
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save(path, quality=QUALITY, optimize=True, progressive=True)
    print(f"{path} ({path.stat().st_size / 1000:.0f} kB)")


if __name__ == "__main__":
    sys.exit(main())
