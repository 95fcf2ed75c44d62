"""Register the table of ablations with Hydra.

Rows are then chosen like files of `conf/ablation/`: `ablation=c2_glimpse`, or all of a table in one
sweep by `sweep=ablation`.
"""

from functools import cache
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from posefilter.cli.ablations import (
    ABLATIONS,
    SIZE,
    Ablation,
    find_variant,
    list_detector_ablations,
    list_pose_ablations,
    list_pose_space_ablations,
    list_steps,
)
from posefilter.cli.plain import to_plain


def resolve_overrides(ablation: Ablation) -> tuple[str, dict[str, str]]:
    """Return the variant that a row changes, and its overrides with those of all its parents.

    A later override of the same group or key replaces an earlier one.
    """
    steps = list_steps(ablation)
    pairs = [override.partition("=") for step in steps for override in step.overrides]
    return find_variant(ablation), {key: value for key, _, value in pairs}


def make_node(ablation: Ablation) -> dict[str, Any]:
    """Return a row as Hydra composes it: a list of defaults, and settings."""
    variant, overrides = resolve_overrides(ablation)
    groups = {"variant": variant} | {k: v for k, v in overrides.items() if "." not in k}
    settings = OmegaConf.from_dotlist([f"{k}={v}" for k, v in overrides.items() if "." in k])
    return {
        "defaults": [{f"override /{group}": choice} for group, choice in groups.items()],
        **to_plain(settings),
    }


def _sweep(names: list[str], groups: dict[str, str], **settings: Any) -> dict[str, Any]:
    return {
        "defaults": [{f"override /{group}": choice} for group, choice in groups.items()],
        **settings,
        "hydra": {"mode": "MULTIRUN", "sweeper": {"params": {"ablation": ",".join(names)}}},
    }


@cache
def register_ablations() -> None:
    """Register the table with Hydra: `ablation=NAME`, `sweep=ablation`, `sweep=ablation_detect` and
    `sweep=ablation_pose`.

    All runs of `sweep=ablation` have the size of the working preset, so that a row differs from the
    next in its modification alone. All runs of `sweep=ablation_detect` have 32 particles, for time;
    those that start from the paper keep its 30 steps, since shorter roll-outs are a modification.
    All runs of `sweep=ablation_pose`, for pose_pf, are of `experiment=small_scenes`.
    """
    store = ConfigStore.instance()
    for ablation in ABLATIONS:
        store.store(
            group="ablation", name=ablation.name, node=make_node(ablation), package="_global_"
        )
    sweeps = {
        "ablation": _sweep(list_pose_ablations(), {SIZE: "${model}"}),
        "ablation_detect": _sweep(list_detector_ablations(), {}, filter={"particles": 32}),
        "ablation_pose": _sweep(list_pose_space_ablations(), {"experiment": "small_scenes"}),
    }
    for name, node in sweeps.items():
        store.store(group="sweep", name=name, node=node, package="_global_")
