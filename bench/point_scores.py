"""What the paper's likelihood gives single points: its figure 5 as numbers.

    python bench/point_scores.py RUN/checkpoints/best.ckpt [--images 50] [--seed 0]

The run is one of `model=pose_pf variant=paper`, or any other whose likelihood learned from labeled
rays. On images of its own test split, points are drawn as in its training, and scored under the
true pose. The paper shows one point on the surface, at +95.77, and one off it, at -115.43.
"""

import sys

import torch
from omegaconf import OmegaConf
from programs import make_parser
from torch import Tensor

from posefilter.cli.build import build_data, quiet
from posefilter.cli.checkpoints import method_of, read_checkpoint
from posefilter.models.candidate_samplers import LabeledRays
from posefilter.models.pose_pf import PosePF
from posefilter.types import Trace

# what is scored: its label, and the score of a point like it in the paper's figure 5
KINDS = {
    "on the surface, observed color": (100.0, "+95.77"),
    "on the surface, random color": (0.0, ""),
    "in front of the surface": (0.0, ""),
    "behind the surface": (-100.0, "-115.43, of a point off the surface"),
}


def sort_points(trace: Trace, tolerance: float) -> dict[str, Tensor]:
    """Return the scores of the points along rays by kind, without padding."""
    state, scores = trace.particles[-1].state, trace.outputs[-1].log_likelihood
    drawn = trace.particles[-1].log_weights.isfinite()
    offset, own = state[..., 2], state[..., 3] > 0.5
    near = offset.abs() <= tolerance
    chosen = (near & own, near & ~own, offset < -tolerance, offset > tolerance)
    return {kind: scores[drawn & one] for kind, one in zip(KINDS, chosen, strict=True)}


def format_table(scores: dict[str, Tensor]) -> str:
    """Return the table as Markdown."""
    lines = [
        "| point | label | points | mean score | 5 % | 95 % | the paper's figure 5 |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for kind, (label, paper) in KINDS.items():
        found = scores[kind].double()
        low, high = (float(found.quantile(q)) for q in (0.05, 0.95))
        figures = f"{found.mean():.1f} | {low:.1f} | {high:.1f}"
        lines.append(f"| {kind} | {label:+.0f} | {len(found)} | {figures} | {paper} |")
    return "\n".join(lines)


def main() -> int:
    """Score the points, and print the table."""
    parser = make_parser(__doc__)
    parser.add_argument("checkpoint")
    parser.add_argument("--images", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    quiet()
    checkpoint = read_checkpoint(options.checkpoint)
    method = method_of(checkpoint)
    sampler = getattr(method, "candidate_sampler", None)
    if not isinstance(method, PosePF) or not isinstance(sampler, LabeledRays):
        print(f"{options.checkpoint}: its likelihood learned from no labeled rays", file=sys.stderr)
        return 2
    settings = OmegaConf.create(checkpoint["recipe"]["settings"])
    settings.data.augment, settings.data.limit_test = {}, options.images
    data = build_data(settings.data, "json")
    data.setup("test")
    method.set_object(data.object_to_learn())
    generator = torch.Generator().manual_seed(options.seed)
    found: dict[str, list[Tensor]] = {kind: [] for kind in KINDS}
    with torch.no_grad():
        for batch in data.test_dataloader():
            trace = sampler(method, method.encode(batch), batch, generator)
            for kind, scores in sort_points(trace, sampler.tolerance).items():
                found[kind].append(scores)
    print(format_table({kind: torch.cat(scores) for kind, scores in found.items()}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
