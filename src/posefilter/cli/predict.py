"""Find the object in one photograph: its pose, a picture of it, and the belief."""

import shlex
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from omegaconf import ListConfig, OmegaConf

from posefilter.cli.checkpoints import method_of, read_checkpoint
from posefilter.cli.components import changes
from posefilter.cli.console import JSON, ended
from posefilter.cli.job import Job
from posefilter.cli.machine import settle
from posefilter.cli.results import write_json
from posefilter.cli.train import quiet
from posefilter.data.readers.decode import read_color, read_depth
from posefilter.data.resize import network_size, resize_depth
from posefilter.errors import UserError
from posefilter.figures.belief import draw_belief
from posefilter.figures.canvas import save_image
from posefilter.figures.overlay import draw_overlay
from posefilter.figures.recording import check_viewer, record
from posefilter.figures.view_data import collect_view_data
from posefilter.geometry.camera import resize_intrinsics
from posefilter.limits import MOST_SIDE
from posefilter.meshes.mesh import Mesh
from posefilter.meshes.store import MeshStore
from posefilter.models.base import PoseEstimator
from posefilter.types import Batch, Belief

VIEW = "view.rrd"


def predict(job: Job) -> None:
    """Write pose.json, overlay.png, belief.png, belief.npz, and where asked for view.rrd."""
    quiet()
    cfg = job.cfg
    settle(cfg.threads, cfg.seed)
    check_view(cfg.view)
    checkpoint = read_checkpoint(cfg.checkpoint)
    method = method_of(checkpoint, changes(cfg))
    if not method.tells_pose:
        raise UserError(
            f"checkpoint={cfg.checkpoint}: {type(method).__name__} detects, and tells no pose"
        )
    for key in ("rgb", "depth", "intrinsics"):
        if cfg[key] is None:
            raise UserError(
                f"{key}: is missing; predict needs rgb=, depth= and intrinsics=fx,fy,cx,cy"
            )
    rgb, depth = read_photograph(cfg.rgb, cfg.depth, cfg.depth_scale)
    K = camera(cfg.intrinsics)
    shape = mesh_of(cfg.meshes, method.model.name) if cfg.meshes else method.model.hull
    width, height = trained_size(checkpoint["recipe"]["settings"])
    size = network_size(depth.shape[0], depth.shape[1], width, height)
    method = method.to("cuda" if torch.cuda.is_available() else "cpu")
    batch = Batch(*(x.to(method.device) for x in as_batch(rgb, depth, K, *size)))
    method.seed = cfg.seed
    began = time.perf_counter()
    with torch.no_grad():
        trace = method.predict_step(batch, 0)
    seconds = time.perf_counter() - began
    belief = Belief(*(x.cpu() for x in trace.belief))
    pose, weights = belief.best[0].double().numpy(), belief.log_weights[0].exp().double()
    folder = job.folder
    folder.mkdir(parents=True, exist_ok=True)
    caption = f"{method.model.name}, score {float(belief.score[0]):.2f}"
    save_image(draw_overlay(rgb, K.numpy(), pose, shape, caption=caption), folder / "overlay.png")
    save_image(draw_belief(belief, method.model, rgb, K.numpy()), folder / "belief.png")
    np.savez_compressed(
        folder / "belief.npz", poses=belief.poses[0].numpy(), weights=weights.float().numpy()
    )
    answer = told(pose, belief_numbers(weights), float(belief.score[0]), seconds, method, job)
    write_json(folder / "pose.json", answer)
    if cfg.view:
        record(collect_view_data(trace, batch, method.model, method.space, shape), folder / VIEW)
    if cfg.console != JSON:
        print(
            f"{method.model.name} at {np.array2string(1000 * pose[:3, 3], precision=1)} mm, "
            f"{seconds:.2f} s"
        )
    files = {
        "pose": "pose.json",
        "overlay": "overlay.png",
        "belief": "belief.png",
        "numbers": "belief.npz",
    }
    files |= {"view": VIEW} if cfg.view else {}
    following = [f"rerun {shlex.quote(str(folder / VIEW))}"] if cfg.view else []
    ended(
        cfg.console,
        "predicted",
        {name: folder / file for name, file in files.items()},
        following,
        **answer,
    )


def trained_size(settings: dict[str, Any]) -> tuple[int | None, int | None]:
    """Return the width and height of the images that a method was trained on [px], null where they
    follow the image's.

    Raises UserError where a checkpoint's settings tell others than images have.
    """
    trained = OmegaConf.create(settings).get("data") or {}
    width, height = trained.get("image_width"), trained.get("image_height")
    for size in (width, height):
        if size is not None and not (isinstance(size, int) and 0 < size <= MOST_SIDE):
            raise UserError(
                f"checkpoint: was trained on images of {size} pixels, which there are not"
            )
    return width, height


def check_view(view: Any) -> None:
    """Raise UserError, before the work is done, where the 3-D view cannot be written."""
    if not isinstance(view, bool):
        raise UserError(f"view={view}: choose true or false")
    if view:
        check_viewer()


def told(
    pose: np.ndarray,
    belief: dict[str, float],
    score: float,
    seconds: float,
    method: PoseEstimator,
    job: Job,
) -> dict[str, Any]:
    """Return pose.json."""
    return {
        "object": method.model.name,
        "camera_from_object": pose.tolist(),
        "rotation": pose[:3, :3].tolist(),
        "translation_mm": (1000 * pose[:3, 3]).tolist(),
        "score": score,
        "belief": belief,
        "seconds": seconds,
        "frame": "OpenCV camera (x right, y down, z ahead), the object as in its mesh file; "
        "camera_from_object in meters",
        "checkpoint": str(job.cfg.checkpoint),
        "rgb": str(job.cfg.rgb),
        "depth": str(job.cfg.depth),
    }


def belief_numbers(weights: torch.Tensor) -> dict[str, float]:
    """Return how sure the belief is.  (N,) float64."""
    entropy = -torch.special.xlogy(weights, weights).sum()
    return {
        "particles": len(weights),
        "effective_particles": float(1 / weights.square().sum()),
        "entropy": float(entropy),
    }


def read_photograph(rgb: str, depth: str, depth_scale: Any) -> tuple[np.ndarray, np.ndarray]:
    """Read color (H, W, 3) uint8 and depth (H, W) [m].

    Raises UserError where they do not fit each other.
    """
    if not isinstance(depth_scale, int | float) or depth_scale <= 0:
        raise UserError(
            f"depth_scale={depth_scale}: units of the depth image in a meter, a positive number "
            f"(e.g. 1000 for mm)"
        )
    color, z = read_color(Path(rgb)), read_depth(Path(depth), float(depth_scale))
    if color.shape[:2] != z.shape:
        raise UserError(
            f"depth={depth}: {z.shape[1]}x{z.shape[0]} pixels, but the color image has "
            f"{color.shape[1]}x{color.shape[0]}"
        )
    if not (z > 0).any():
        raise UserError(f"depth={depth}: no pixel has depth")
    if np.median(z[z > 0]) > 30 or np.median(z[z > 0]) < 0.05:
        raise UserError(
            f"depth_scale={depth_scale}: the median depth would be {np.median(z[z > 0]):.3g} m; "
            f"is it {1000} or 10000?"
        )
    return color, z


def camera(numbers: Any) -> torch.Tensor:
    """Return K (3, 3) float64 [px] of fx, fy, cx, cy."""
    parts = list(numbers) if isinstance(numbers, ListConfig | list) else str(numbers).split(",")
    try:
        fx, fy, cx, cy = (float(part) for part in parts)
    except ValueError as error:
        raise UserError(f"intrinsics={numbers}: four numbers are due, fx,fy,cx,cy [px]") from error
    if fx <= 0 or fy <= 0:
        raise UserError(f"intrinsics={numbers}: focal lengths must be positive [px]")
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


def as_batch(rgb: np.ndarray, depth: np.ndarray, K: torch.Tensor, height: int, width: int) -> Batch:
    """Return the photograph, resized as training images were; what is not known of it is empty."""
    before = depth.shape
    if (height, width) != before:
        how = cv2.INTER_AREA if width <= before[1] else cv2.INTER_LINEAR
        rgb = cv2.resize(rgb, (width, height), interpolation=how)
        depth = resize_depth(depth, height, width)
        K = resize_intrinsics(K, width / before[1], height / before[0])
    image = torch.from_numpy(np.ascontiguousarray(rgb.transpose(2, 0, 1))).float()[None] / 255
    z = torch.from_numpy(np.ascontiguousarray(depth)).float()[None, None]
    none = torch.zeros(1, dtype=torch.int64)
    return Batch(
        image,
        z,
        torch.zeros_like(z, dtype=torch.bool),
        K.float()[None],
        torch.eye(4)[None],
        none,
        none,
        torch.full((1,), torch.nan),
    )


def mesh_of(meshes: str, name: str) -> Mesh:
    """Return the object's mesh, for its exact outline."""
    return MeshStore(meshes).load(name)
