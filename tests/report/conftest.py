"""Runs and sweeps such as trainings leave, made of numbers that the tests know."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image
from torch.utils.tensorboard import SummaryWriter

MARK = (250, 30, 200)  # a color that nothing else on the page has


def metrics(auc: float, **others: Any) -> dict[str, Any]:
    """Return a metrics.json."""
    add = {"auc": auc, "recall_01d": 90.0, "recall_2cm": 80.0, "median_mm": 4.25}
    belief = {
        "entropy": 2.0,
        "effective_particles": 12.0,
        "distance_coverage_50": 48.0,
        "distance_coverage_90": 41.0,
        "mass_2cm": 0.5,
    }
    return {
        "instances": 20,
        "missed": 5,
        "add": add,
        "add_s": {**add, "auc": auc + 1},
        "iou": 0.876,
        "particles_on_object": 0.75,
        "seconds_per_image": 1.5,
        "belief": belief,
        "by_visibility": {"0.3-0.5": {"instances": 7, "add": {**add, "auc": 33.25}, "add_s": add}},
        "model": "pose_pf",
        "loss": "contrast",
        "overrides": ["filter.particles=9"],
        **others,
    }


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Return the folder of a whole run."""
    folder = tmp_path / "run <1>"
    (folder / ".hydra").mkdir(parents=True)
    diagnostics = {"off_frame": [0.0, 0.1, 0.625], "pairwise_cosine": 0.95, "offset_r2": 0.5}
    (folder / "metrics.json").write_text(json.dumps(metrics(87.5, diagnostics=diagnostics)))
    (folder / "data.json").write_text(
        json.dumps({"objects": ["carton"], "source": "scenes", "root": "data/x"})
    )
    config = {
        "seed": 3,
        "filter": {"particles": 9, "steps": 14},
        "out": "elsewhere",
        "trainer": {"max_steps": 100},
    }
    (folder / ".hydra" / "config.yaml").write_text(yaml.safe_dump(config))
    choices = {"model": "pose_pf", "variant": "working", "loss": "contrast"}
    hydra = {
        "hydra": {
            "runtime": {"choices": choices},
            "overrides": {"task": ["filter.particles=9", "seed=3"]},
        }
    }
    (folder / ".hydra" / "hydra.yaml").write_text(yaml.safe_dump(hydra))
    with SummaryWriter(str(folder)) as log:
        for step in range(0, 100, 10):
            log.add_scalar("train/loss", 5 / (1 + step), step, walltime=1000.0 + step / 2)
        for step, score in ((49, 60.0), (99, 40.0)):
            log.add_scalar("val/score", score, step, walltime=1000.0 + step / 2)
            log.add_scalar("val/add/auc", score, step, walltime=1000.0 + step / 2)
        for iteration, ess in enumerate((0.9, 0.5, 0.25)):
            log.add_scalar(f"filter/ess/step_{iteration:02d}", ess, 99)
        log.add_image("3_belief/belief", np.zeros((8, 8, 3), np.uint8), 99, dataformats="HWC")
        log.add_image("1_poses/overlays", np.zeros((8, 8, 3), np.uint8), 99, dataformats="HWC")
    (folder / "figures").mkdir()
    for name in ("worst_2", "worst_10", "best_0", "validation_overlays"):
        Image.fromarray(np.full((240, 320, 3), MARK, np.uint8)).save(
            folder / "figures" / f"{name}.png"
        )
    return folder


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    """Return the folder of a sweep: two numbers of particles, two refinements, three seeds, one run
    not finished.
    """
    folder = tmp_path / "sweep"
    offset = {"none": 0.0, "gradient": 10.0}
    for particles in (50, 1000):
        for refine in ("none", "gradient"):
            for seed in (0, 1, 2):
                said = [f"filter.particles={particles}", f"refine={refine}", f"seed={seed}"]
                own = folder / ",".join(said)
                (own / ".hydra").mkdir(parents=True)
                (own / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(said))
                if (particles, refine, seed) == (1000, "none", 2):
                    continue
                auc = 60 + particles / 100 + offset[refine] + (-2.0, 0.0, 3.0)[seed]
                written = metrics(auc, overrides=[*said, f"out={own}"])
                (own / "metrics.json").write_text(json.dumps(written))
    asked = {
        "hydra": {
            "sweeper": {"params": {"refine": "none,gradient"}},
            "overrides": {"task": ["filter.particles=1000,50"]},
        }
    }
    (folder / "multirun.yaml").write_text(yaml.safe_dump(asked))
    return folder
