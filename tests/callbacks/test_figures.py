"""Figures and health of a real validation, run by a filter that is told the truth."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning import Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from PIL import Image
from scipy.spatial import ConvexHull
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.utils.data import DataLoader

from posefilter.callbacks.drawings import DRAWINGS
from posefilter.callbacks.figures import Figures, evaluate_quietly
from posefilter.callbacks.gallery import compute_errors, draw_tile
from posefilter.callbacks.health import FilterHealth
from posefilter.callbacks.tensorboard import Budget
from posefilter.errors import UserError
from posefilter.figures.canvas import TRUTH
from posefilter.figures.layout import THUMBNAIL, TITLE, WIDTH, tile_width
from posefilter.figures.overlay import view_poses
from posefilter.filters.estimate import Mean
from posefilter.filters.initialize import FromProposals
from posefilter.filters.loop import ParticleFilter
from posefilter.filters.propagate import Gaussian
from posefilter.filters.refine import NoRefine
from posefilter.filters.resample import Systematic
from posefilter.filters.reweight import CurrentLikelihood
from posefilter.filters.schedule import Geometric
from posefilter.geometry.camera import intrinsics
from posefilter.geometry.pose import make_pose, move_about
from posefilter.geometry.spaces import PoseSpace
from posefilter.models.base import PoseEstimator, with_lightning
from posefilter.types import Batch, ObjectModel, ParticleOutput, Particles, Step, Trace

H, W, IMAGES = 48, 64, 8


def model() -> ObjectModel:
    hull = torch.tensor(
        [[x, y, z] for x in (-0.05, 0.05) for y in (-0.08, 0.08) for z in (-0.1, 0.1)]
    )
    return ObjectModel("box", hull, torch.zeros(3), 0.14, 0.28, torch.eye(4)[None], hull)


def scenes() -> list[Batch]:
    out = []
    for i in range(IMAGES):
        pose = make_pose(torch.eye(3), torch.tensor([0.02 * i - 0.08, 0.0, 0.8]))
        mask = torch.zeros(1, H, W, dtype=torch.bool)
        mask[:, 16:32, 20:44] = True
        K, one = intrinsics(60.0, 60.0, (W - 1) / 2, (H - 1) / 2), torch.tensor(1.0)
        out.append(
            Batch(
                torch.full((3, H, W), 0.5),
                torch.ones(1, H, W),
                mask,
                K,
                pose,
                torch.tensor(0),
                torch.tensor(i),
                one,
            )
        )
    return out


@with_lightning
class Told(PoseEstimator):
    """Knows the truth, but believes the object of image i to be i cm to the right."""

    provides = ("pose", "pose_space", "propose_poses")

    def __init__(self) -> None:
        pieces = (
            FromProposals(),
            Geometric(0.03, 0.005),
            CurrentLikelihood(),
            Systematic(),
            Gaussian(0.4),
            Mean(),
            NoRefine(),
        )
        loss: Any = None
        super().__init__(ParticleFilter(100, 4, *pieces), loss, partial(torch.optim.SGD, lr=0.1))
        self.set_object(model())
        self.weight = torch.nn.Parameter(torch.ones(1))

    @property
    def space(self) -> PoseSpace:
        return PoseSpace((0.0, 0.0, 0.0), 0.14)

    def encode(self, batch: Batch) -> torch.Tensor:
        shift = torch.zeros(len(batch.rgb), 6)
        shift[:, 0] = 0.01 * batch.frame_id
        known = scenes()  # the batch of a validation holds no truth
        truth = torch.stack([known[i].camera_from_object for i in batch.frame_id.tolist()])
        return move_about(truth, shift, torch.zeros(3))

    def measure(
        self, encoding: torch.Tensor, particles: Particles, step: Step, generator: torch.Generator
    ) -> ParticleOutput:
        likely = (
            -0.5 * (self.space.distance(particles.state, encoding[:, None]) / step.sigma).square()
        )
        still = torch.zeros(*particles.state.shape[:2], 6)
        return ParticleOutput(likely, still, particles.state, particles.latent)

    def propose_poses(
        self, encoding: torch.Tensor, particles: int, generator: torch.Generator
    ) -> torch.Tensor:
        tangent = torch.randn(len(encoding), particles, 6, generator=generator) * torch.tensor(
            [0.03] * 3 + [0.2] * 3
        )
        return move_about(encoding[:, None].expand(-1, particles, 4, 4), tangent, torch.zeros(3))


def validate(folder: Path, *callbacks: Any) -> None:
    trainer = Trainer(
        accelerator="cpu", logger=TensorBoardLogger(folder, name="", version=""),
        callbacks=list(callbacks),
        enable_progress_bar=False, enable_model_summary=False, enable_checkpointing=False,
    )  # fmt: skip
    trainer.validate(Told(), DataLoader(scenes(), batch_size=3), verbose=False)  # type: ignore[arg-type]
    for logger in trainer.loggers:
        logger.finalize("success")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Figures, FilterHealth]:
    folder = tmp_path_factory.mktemp("run")
    figures, health = Figures(folder / "figures", best=2, worst=2), FilterHealth(folder / "figures")
    validate(folder, figures, health)
    return folder, figures, health


def test_best_and_worst_are_the_best_and_the_worst(run: tuple[Path, Figures, FilterHealth]) -> None:
    kept = run[1]._selection.kept
    assert [one.frame_id for one in kept["first"]] == [0, 1, 2, 3, 4]
    assert [one.frame_id for one in kept["best"]] == [0, 1]
    assert [one.frame_id for one in kept["worst"]] == [7, 6]
    assert kept["worst"][0].error == pytest.approx(0.07, abs=0.01)


def test_figures_are_in_tensorboard_and_in_the_folder(
    run: tuple[Path, Figures, FilterHealth],
) -> None:
    folder = run[0]
    board = EventAccumulator(str(folder), size_guidance={"images": 0, "scalars": 0})
    board.Reload()
    names = {
        "overlays",
        "worst",
        "best",
        "particles",
        "silhouettes",
        "belief",
        "animation",
        "health",
    }
    assert {file.stem for file in (folder / "figures").iterdir()} == {
        f"validation_{name}" for name in names
    }
    tags = sorted(board.Tags()["images"])  # as TensorBoard orders them
    assert tags == [
        "1_poses/overlays", "1_poses/worst", "2_filter/animation", "2_filter/health",
        "2_filter/particles",
        "3_belief/belief",
    ]  # fmt: skip
    for tag, file in (
        ("1_poses/overlays", "validation_overlays"),
        ("2_filter/health", "validation_health"),
    ):
        written = (folder / "figures" / f"{file}.jpg").read_bytes()
        assert board.Images(tag)[0].encoded_image_string == written
    with Image.open(folder / "figures" / "validation_overlays.jpg") as overlays:
        picture = np.asarray(overlays.convert("RGB"))
    assert picture.shape[1] == WIDTH
    assert (np.abs(picture.astype(int) - 128) < 4).all(-1).mean() > 0.3  # the gray photographs
    animation = board.Images("2_filter/animation")[0]
    assert (
        animation.encoded_image_string
        == (folder / "figures" / "validation_animation.gif").read_bytes()
    )
    with Image.open(folder / "figures" / "validation_animation.gif") as moving:
        assert moving.n_frames == 7  # four clouds, two frames from one to the next
        assert moving.size == (animation.width, animation.height)
    assert board.Scalars("filter/sigma_m/step_00")[0].value == pytest.approx(0.03)
    assert board.Scalars("filter/sigma_m/step_03")[0].value == pytest.approx(0.005)


def test_titles_of_all_figures_are_read_in_thumbnails(
    run: tuple[Path, Figures, FilterHealth],
) -> None:
    """Shown as TensorBoard does, the first letter of each title is a capital of 12 pixels: its
    small letters have 9.
    """
    files = sorted((run[0] / "figures").iterdir())
    assert len(files) == 8
    for file in files:
        with Image.open(file) as image:
            height = image.height * THUMBNAIL // image.width
            small = np.asarray(
                image.convert("L").resize((THUMBNAIL, height), Image.Resampling.NEAREST)
            )
        ink = small[: round(TITLE * 1.25) // 2] < 128
        columns = np.nonzero(ink.any(0))[0]
        letter = np.nonzero(ink[:, columns[0] : columns[0] + 7].any(1))[0]
        assert letter[-1] - letter[0] + 1 >= 12, file.name


def test_health_is_the_mean_over_all_images(run: tuple[Path, Figures, FilterHealth]) -> None:
    curves, health = run[2].curves(), run[2]
    assert health._images == IMAGES
    assert curves["spread_m"][0] == pytest.approx(0.03 * 3**0.5, rel=0.5)
    assert curves["spread_m"][-1] < curves["spread_m"][0]
    assert all(0 < share <= 1 for share in curves["ess"])


def test_drawing_changes_nothing(tmp_path: Path) -> None:
    torch.manual_seed(3)
    np.random.seed(3)  # noqa: NPY002
    before, other = torch.get_rng_state(), np.random.get_state()[1].copy()  # type: ignore[index, union-attr]  # noqa: NPY002
    method, figures = Told(), Figures(tmp_path, max_time_fraction=None)
    state = {name: value.clone() for name, value in method.state_dict().items()}
    torch.set_rng_state(before)
    trainer = Trainer(
        accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False
    )
    batch = torch.utils.data.default_collate(scenes()[:2])
    trace = method.filter(batch, method, torch.Generator().manual_seed(0))
    figures.on_validation_epoch_start(trainer, method)
    figures.on_validation_batch_end(trainer, method, trace, batch, 0)
    figures.on_validation_epoch_end(trainer, method)
    assert len(list(tmp_path.glob("*.jpg"))) == 6
    assert len(list(tmp_path.glob("*.gif"))) == 1
    assert torch.equal(torch.get_rng_state(), before)
    assert (np.random.get_state()[1] == other).all()  # type: ignore[index]  # noqa: NPY002
    assert all(torch.equal(value, state[name]) for name, value in method.state_dict().items())


def test_every_second_validation_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    method, figures = Told(), Figures(tmp_path, every_n_validations=2, max_time_fraction=None)
    trainer = Trainer(
        accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False
    )
    batch = torch.utils.data.default_collate(scenes()[:2])
    trace = method.filter(batch, method, torch.Generator().manual_seed(0))
    drawn: list[int] = []
    now = [0]
    monkeypatch.setattr(Figures, "_draw", lambda *given: drawn.append(now[0]))
    for validation in range(5):
        now[0] = validation
        figures.on_validation_epoch_start(trainer, method)
        figures.on_validation_batch_end(trainer, method, trace, batch, 0)
        figures.on_validation_epoch_end(trainer, method)
    assert drawn == [0, 2, 4]


def test_drawing_that_costs_too_much_is_put_off_until_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    method, figures = Told(), Figures(tmp_path, max_time_fraction=0.05)
    trainer = Trainer(
        accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False
    )
    drawn: list[int] = []
    now = [0]

    @contextmanager
    def spend(self: Budget) -> Iterator[None]:
        yield
        self.last = 1.0
        self.drawn += 1.0

    monkeypatch.setattr(Budget, "spend", spend)
    monkeypatch.setattr(Figures, "_draw", lambda *given: drawn.append(given[-1]))
    monkeypatch.setattr(Trainer, "global_step", property(lambda self: now[0]))
    batch = torch.utils.data.default_collate(scenes()[:2])
    trace = method.filter(batch, method, torch.Generator().manual_seed(0))
    for validation in range(11):
        now[0] = validation
        figures.on_validation_epoch_start(trainer, method)
        figures.on_validation_batch_end(trainer, method, trace, batch, 0)
        figures.budget._start -= 5.0  # a validation of five seconds pays for a quarter of a drawing
        figures.on_validation_epoch_end(trainer, method)
    assert drawn == [0, 7]  # the eighth has paid for two
    figures.on_fit_end(trainer, method)
    figures.on_fit_end(trainer, method)
    assert drawn == [0, 7, 10]


def test_budget_without_limit_always_allows() -> None:
    budget = Budget(None)
    budget.last = budget.drawn = 100.0
    assert budget.allows()


def test_estimates_that_are_no_numbers_are_the_worst() -> None:
    method, batch = Told(), torch.utils.data.default_collate(scenes()[:2])
    trace: Trace = method.filter(batch, method, torch.Generator().manual_seed(0))
    trace.belief.best[0] = torch.nan
    errors = compute_errors(trace, batch, method, model().points)
    assert errors[0] == torch.inf
    assert errors[1] < 0.05


def test_one_figure_alone_is_switched_off_by_its_name(tmp_path: Path) -> None:
    assert set(Figures(exclude=["animation", "field"]).drawings) == set(DRAWINGS) - {
        "animation",
        "field",
    }
    with pytest.raises(
        UserError,
        match=r"figures.exclude=fild: there is no such figure; there "
        r"are .*field",
    ):
        Figures(exclude=["fild"])


def test_a_method_is_left_in_the_mode_that_it_was_in() -> None:
    method = Told()
    method.train()
    method.filter.eval()
    with evaluate_quietly(method):
        assert not method.training
        assert not torch.is_grad_enabled()
    assert method.training
    assert not method.filter.training
    assert torch.is_grad_enabled()


def test_overlays_outline_lies_on_the_mask_of_a_worst_image(
    run: tuple[Path, Figures, FilterHealth],
) -> None:
    worst = run[1]._selection.kept["worst"][0]
    width = tile_width(3)
    view = view_poses([worst.estimate, worst.truth], model().hull, worst.intrinsics, H, W, width)
    tile = draw_tile(worst, model().hull, True)[-view.height :]
    green = np.argwhere((tile == TRUTH).all(-1))[:, ::-1]

    def farthest_corner(pose: np.ndarray) -> float:
        corners = model().hull.numpy() @ pose[:3, :3].T + pose[:3, 3]
        places = view.place(corners[:, :2] / corners[:, 2:] * 60 + [(W - 1) / 2, (H - 1) / 2])
        outer = places[ConvexHull(places).vertices]
        return float(np.linalg.norm(outer[:, None] - green[None], axis=-1).min(1).max())

    # the other outline lies over some of it; enlarged, 15 px are 1.5 cm
    assert farthest_corner(worst.truth) < 6
    assert farthest_corner(worst.estimate) > 15  # it is 7 cm away
