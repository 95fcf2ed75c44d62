"""A checkpoint of an earlier version is read where names alone have changed, and else refused in
one line that names what has."""

import importlib
from pathlib import Path

import pytest
import torch

from posefilter.cli.instantiate import accepted, instantiate_recipe, locate
from posefilter.cli.old_names import ARGUMENTS, CLASSES
from posefilter.cli.recipe import check_recipe
from posefilter.confidence.calibration import read_calibration
from posefilter.errors import UserError

WEIGHTS = Path(__file__).parents[2] / "weights" / "003_cracker_box.ckpt"
REFINE = [
    {"_target_": "posefilter.filters.refine.Rescore", "top": 20},
    {"_target_": "posefilter.filters.refine.MeanShift", "rounds": 8, "start": 0.02, "end": 0.01},
]
OLD = {
    "model": {
        "_target_": "posefilter.models.pose_pf.PosePF",
        "even_points": True,
        "filter": "${filter}",
        "loss": {"_target_": "posefilter.losses.contrast.Contrast"},
        "start": "not an argument that was renamed here",
        "train_filter": {
            "_target_": "posefilter.filters.loop.ParticleFilter",
            "first_particles": None,
        },
        "loss_schedule": [
            {
                "_target_": "posefilter.models.loss_schedule.Stage",
                "until": 1.0,
                "factors": {"relevance": 0.0, "pose": 0.5},
            }
        ],
        "encoder": {"_target_": "posefilter.nets.context.ConvEncoder", "most_px": 192},
    },
    "data": {
        "_target_": "posefilter.data.module.PoseDataModule",
        "source": "bop",
        "points": 500,
        "model_points": None,
        "options": {"part": "test", "inverted": False},
        "generate": {
            "_target_": "posefilter.synthetic.generate.generate",
            "occlusion": 0.75,
            "occluded_share": 0.35,
            "tabletop_share": 0.65,
            "absent_share": 0.0,
            "covered_frames": 0,
            "lookalike_texture": "own",
        },
    },
    "filter": {
        "_target_": "posefilter.filters.loop.ParticleFilter",
        "zoom_diameter": 0.4,
        "resample": {"_target_": "posefilter.filters.transport.OptimalTransport"},
        "reweight": {"_target_": "posefilter.filters.reweight.Annealed"},
        "schedule": {"_target_": "posefilter.filters.schedule.Geometric", "start": 4, "stop": 1},
        "refine": {"_target_": "posefilter.filters.refine.Chain", "components": REFINE},
    },
}
NEW = {
    "model": {
        "_target_": "posefilter.models.pose_pf.PosePF",
        "quasi_monte_carlo": True,
        "filter": "${filter}",
        "loss": {"_target_": "posefilter.losses.contrastive.Contrastive"},
        "start": "not an argument that was renamed here",
        "train_rollout": {
            "_target_": "posefilter.filters.loop.ParticleFilter",
            "initial_particles": None,
        },
        "loss_schedule": [
            {
                "_target_": "posefilter.models.loss_schedule.Stage",
                "until": 1.0,
                "loss_weights": {"objectness": 0.0, "pose": 0.5},
            }
        ],
        "encoder": {"_target_": "posefilter.nets.encoders.UNetEncoder", "max_width_px": 192},
    },
    "data": {
        "_target_": "posefilter.data.module.PoseDataModule",
        "num_model_points": 500,
        "model_points_dir": None,
        "source": "bop",
        "options": {"split": "test", "inverted": False},
        "generate": {
            "_target_": "posefilter.synthetic.generate.generate",
            "max_occlusion": 0.75,
            "occluded_fraction": 0.35,
            "tabletop_fraction": 0.65,
            "absent_fraction": 0.0,
            "fully_occluded_frames": 0,
            "lookalike_texture": "same",
        },
    },
    "filter": {
        "_target_": "posefilter.filters.loop.ParticleFilter",
        "magnified_width": 0.4,
        "resample": {"_target_": "posefilter.filters.transport.SampledTransport"},
        "reweight": {"_target_": "posefilter.filters.reweight.CurrentLikelihood"},
        "schedule": {
            "_target_": "posefilter.filters.schedule.Geometric",
            "initial_sigma": 4,
            "final_sigma": 1,
        },
        "refine": {
            "_target_": "posefilter.filters.refine.Compose",
            "components": [
                {"_target_": "posefilter.filters.refine.Rescore", "top_k": 20},
                {
                    "_target_": "posefilter.filters.refine.MeanShift",
                    "iterations": 8,
                    "initial_scale": 0.02,
                    "final_scale": 0.01,
                },
            ],
        },
    },
}


def test_an_old_recipe_is_read_by_todays_names() -> None:
    choices = {
        "loss": "contrast",
        "filter/reweight": "annealed",
        "filter/refine": "mean_shift",
        "filter/resample@model.train_filter.resample": "never",
    }
    found = check_recipe({"choices": choices, "settings": OLD})
    assert found["settings"] == NEW
    assert found["choices"] == {
        "loss": "contrastive",
        "filter/reweight": "current_likelihood",
        "filter/refine": "mean_shift",
        "filter/resample@model.train_rollout.resample": "none",
    }


@pytest.mark.parametrize(
    ("setting", "old", "new"),
    [
        ("model", "train_filter", "train_rollout"),
        ("filter", "zoom_diameter", "magnified_width"),
        ("filter", "first_particles", "initial_particles"),
    ],
)
def test_a_class_of_ones_own_has_the_arguments_of_its_base(
    setting: str, old: str, new: str
) -> None:
    own = {"_target_": "ownpf.method.Own", "seed": 1}
    found = check_recipe({"choices": {}, "settings": {setting: own | {old: None}}})
    assert found["settings"] == {setting: own | {new: None}}


def test_an_argument_with_both_names_keeps_both_for_the_refusal() -> None:
    both = {
        "_target_": "posefilter.filters.schedule.Geometric",
        "start": 4,
        "initial_sigma": 2,
        "final_sigma": 1,
    }
    found = check_recipe({"choices": {}, "settings": {"filter": both}})
    assert found["settings"]["filter"] == both
    with pytest.raises(UserError) as refusal:
        instantiate_recipe(found["settings"]["filter"], "filter")
    assert str(refusal.value) == "filter.start: is now initial_sigma"


@pytest.mark.parametrize("options", [5, "part", ["part"], None, {"part": 1, "split": 2}])
def test_options_that_are_none_or_of_both_names_stay(options: object) -> None:
    data = {"_target_": "posefilter.data.module.PoseDataModule", "options": options}
    found = check_recipe({"choices": {}, "settings": {"data": data}})
    assert found["settings"]["data"] == data


def test_old_features_of_a_calibration_are_read_by_todays_names() -> None:
    checkpoint = torch.load(WEIGHTS, map_location="cpu", weights_only=True)
    plain = checkpoint["calibration"]
    old = {"free_space": "solid", "mask_precision": "explained", "mask_recall": "recognized"}
    old["top_objectness"] = "glimpsed"
    before = plain | {"features": [old.get(one, one) for one in plain["features"]]}
    assert before != plain
    assert read_calibration(before, "old") == read_calibration(plain, "new")


@pytest.mark.parametrize(
    ("recipe", "told"),
    [
        ({"choices": {"initialise": "uniform"}, "settings": {}}, "initialise is now filter/init"),
        ({"choices": {}, "settings": {"rung": "c2_glimpse"}}, "rung is now ablation"),
        ({"choices": {"deviation": "pose_pf/ours"}, "settings": {}}, "deviation is now preset"),
        ({"choices": {"place_gradient": "flows"}, "settings": {}}, "is now model.detach_position"),
    ],
)
def test_an_old_recipe_names_what_to_do(recipe: dict, told: str) -> None:
    with pytest.raises(UserError) as refusal:
        check_recipe(recipe)
    said = str(refusal.value)
    assert said.startswith("was written by an earlier version")
    assert told in said
    assert said.endswith("train it again")
    assert "\n" not in said


def test_todays_recipe_is_not_taken_for_an_old_one() -> None:
    recipe = {"choices": {"filter/initialize": "uniform"}, "settings": {"filter": {"steps": 3}}}
    assert check_recipe(recipe) == recipe


@pytest.mark.parametrize("place", sorted(ARGUMENTS))
def test_a_class_takes_its_arguments_by_todays_names_alone(place: str) -> None:
    module, _, name = place.rpartition(".")
    known, _ = accepted(getattr(importlib.import_module(f"posefilter.{module}"), name))
    assert set(ARGUMENTS[place].values()) <= set(known)
    assert not set(ARGUMENTS[place]) & set(known)


@pytest.mark.parametrize("old", sorted(CLASSES))
def test_an_old_class_is_answered_by_the_new_one_which_is_there(old: str) -> None:
    with pytest.raises(UserError) as refusal:
        locate(f"posefilter.{old}", "filter.resample")
    assert str(refusal.value).endswith(
        f"_target_=posefilter.{old}: is now posefilter.{CLASSES[old]}"
    )
    assert locate(f"posefilter.{CLASSES[old]}", "filter.resample").__name__ in CLASSES[old]
