"""Estimate an object's pose by ONNX Runtime and NumPy alone: a particle filter over pixels.

python export.py checkpoint=RUN format=onnx out=drill          # of a patch_pf or pixel_pf
python examples/onnx/pixels.py drill rgb.png depth.png fx,fy,cx,cy 10000
"""

import numpy as np
from poses import (
    draw,
    draw_poses,
    fit_rigid,
    open_export,
    print_estimate,
    read_arguments,
    resample,
    softmax,
    take_image,
)


class PixelFilter:
    """What `export.py format=onnx` wrote of a `patch_pf` or `pixel_pf`."""

    def __init__(self, folder, threads=1):
        self.settings, self.encode, self.measure = open_export(folder, threads)

    def estimate(self, rgb, depth, intrinsics, seed=0, start=None):
        """RGB (H, W, 3) uint8, depth (H, W) [m], (3, 3) -> camera_from_object (4, 4), its score,
        and the last particles by name; `start` (N, 2) [px]: the first ones, else they are drawn.
        """
        s, rng = self.settings, np.random.default_rng(seed)
        scene = run(self.encode, take_image(s, rgb, depth, intrinsics))
        state = self.draw_pixels(scene, rng) if start is None else start
        latent = np.zeros((len(state), s["latent_width"]), np.float32)
        found, weights = {}, np.ones(len(state)) / len(state)
        for number, sigma in enumerate(s["levels"]):
            if number:
                kept = slice(None)
                if s["resample"] == "systematic":
                    kept = resample(weights, s["particles"], rng)
                state, latent = state[kept], found["next_latent"][kept]
                for kernel in s["propagate"]:
                    if kernel["kind"] == "displacement":
                        state = state + found["displacement"][kept]
                    else:
                        noise = rng.standard_normal(state.shape, dtype=np.float32)
                        state = state + np.float32(sigma * kernel["noise_scale"]) * noise
            found = run(self.measure, {"state": state, "latent": latent, **scene})
            weights = softmax(found["log_likelihood"])
        found["state"] = state
        if s["estimate"]["kind"] == "agreement":
            return *self.agree(found, rng), found
        best = found["log_likelihood"].argmax()
        return found["pose"][best], float(found["log_likelihood"][best]), found

    def draw_pixels(self, scene, rng):
        """The first particles (N, 2) [px] of the network's image."""
        s, start = self.settings, self.settings["initialize"]
        count, size = s["first_particles"], np.float32(s["network"])
        if start["kind"] == "uniform":
            return np.float32(rng.random((count, 2))) * size - np.float32(0.5)
        weight, mix = scene["objectness"], start["uniform_fraction"]
        weight = (1 - mix) * weight / weight.sum().clip(1e-12) + max(mix, 1e-6) / weight.size
        row, column = np.divmod(draw(weight.ravel(), rng, count), weight.shape[1])
        cell = np.stack([column, row], -1) + rng.random((count, 2))
        return np.float32(cell * size / weight.shape[::-1] - 0.5)

    def agree(self, found, rng):
        """The pose that most particles' object points agree on, and its score."""
        s, rule = self.settings, self.settings["estimate"]
        point, share, position = (found[name] for name in ("point", "share", "position"))
        likelihood, scale = np.exp(found["log_likelihood"]), rule["scale_m"]
        relative = np.exp(found["log_likelihood"] - found["log_likelihood"].max())
        weight, center = relative * found["known"], np.float32(s["center"])
        count = rule["hypotheses"]
        votes = draw_poses(point, weight, share, position, center, s["radius"], count, rng)
        weight = weight + 1e-9
        hypotheses = np.concatenate([votes, found["pose"][np.argsort(-weight)[:count]]])
        objects = center + s["radius"] * position
        support = [(weight[:, None] * share * inliers(pose, objects, point, 2 * scale)).sum()
                   for pose in hypotheses]  # fmt: skip
        best, rows = hypotheses[np.argmax(support)], np.arange(len(point))
        for i in range(rule["iterations"]):
            width = scale * 2 ** (2 - 2 * i / max(rule["iterations"] - 1, 1))
            fit = share * inliers(best, objects, point, width)
            option = fit.argmax(-1)
            best = fit_rigid(objects[rows, option], point, weight * fit[rows, option])
        agreeing = (share * (inliers(best, objects, point, scale) > 0.04)).sum(-1)
        return best, float((weight * agreeing).sum() / weight.sum() * likelihood.max())


def inliers(pose, objects, point, scale):
    """Geman-McClure weights of correspondences under a pose: (N, k, 3), (N, 3) -> (N, k)."""
    offset = objects @ pose[:3, :3].T + pose[:3, 3] - point[:, None]
    return 1 / (1 + (offset**2).sum(-1) / scale**2) ** 2


def run(session, given):
    """Run a network on what it takes of `given`, and return its outputs by name."""
    names = [output.name for output in session.get_outputs()]
    inputs = {one.name: given[one.name] for one in session.get_inputs()}
    return dict(zip(names, session.run(names, inputs), strict=True))


if __name__ == "__main__":
    place, *images = read_arguments("pixels")
    print_estimate(PixelFilter(place), images)
