"""Estimate an object's pose by ONNX Runtime and NumPy alone: a particle filter over poses.

    python export.py checkpoint=003_cracker_box format=onnx out=cracker
    python examples/onnx/poses.py cracker rgb.png depth.png fx,fy,cx,cy 10000

Needs numpy, onnxruntime, and opencv-python-headless to read the images.
"""

import json
import sys
from pathlib import Path
from statistics import NormalDist

import numpy as np
import onnxruntime


def open_export(folder, threads):
    """What `export.py format=onnx` wrote: its settings, and the networks `encode` and `measure`."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    networks = (
        onnxruntime.InferenceSession(Path(folder) / f"{name}.onnx", options)
        for name in ("encode", "measure")
    )
    return json.loads((Path(folder) / "filter.json").read_text()), *networks


class PoseFilter:
    """What `export.py format=onnx` wrote of a `pose_pf`."""

    def __init__(self, folder, threads=1):
        self.settings, self.encode, self.measure = open_export(folder, threads)
        self.center, self.radius = np.float32(self.settings["center"]), self.settings["radius"]

    def estimate(self, rgb, depth, intrinsics, seed=0):
        """RGB (H, W, 3) uint8, depth (H, W) [m], (3, 3) -> camera_from_object (4, 4), its score,
        and the belief: poses (N, 4, 4), weights (N,).
        """
        s, rng = self.settings, np.random.default_rng(seed)
        names = [output.name for output in self.encode.get_outputs()]
        image = {"rgb": rgb, "depth": np.float32(depth), "intrinsics": np.float32(intrinsics)}
        scene = dict(zip(names, self.encode.run(names, image), strict=True))
        poses = draw_poses(*(scene[name] for name in ("point", "weight", "share", "position")),
                           self.center, self.radius, s["first_particles"], rng)  # fmt: skip
        weights = np.ones(len(poses)) / len(poses)
        for number, sigma in enumerate(s["levels"]):
            if number:
                if s["resample"] == "systematic":
                    poses = poses[resample(weights, s["particles"], rng)]
                for kernel in s["propagate"]:
                    poses = self.propagate(poses, kernel, sigma, rng)
            scores = self.score(scene, poses, sigma, s["points"], rng)
            weights = softmax(scores)
        best, score = poses[scores.argmax()], scores.max()
        for step in s["refine"]:
            if step["kind"] == "icp":
                best = self.align(image, best, **step)
                continue
            refine = self.rescore if step["kind"] == "rescore" else self.shift
            best, score = refine(scene, best, poses, weights, rng, **step)
        return best, float(score), poses, weights

    def score(self, scene, poses, sigma, points, rng):
        """Log-likelihoods (N,) at a noise level [m], from so many image points."""
        noise = draw_points(points, self.settings["quasi_monte_carlo"], rng)
        given = {"poses": poses, "sigma": np.array(sigma, np.float32), "noise": noise, **scene}
        names = [one.name for one in self.measure.get_inputs()]
        return self.measure.run(None, {name: given[name] for name in names})[0]

    def scale(self, sigma):
        """Standard deviations of a shift [m] and a turn [rad] that move the surface by sigma."""
        return np.repeat(np.float32([sigma, min(sigma / self.radius, 1.2)]), 3)

    def propagate(self, poses, kernel, sigma, rng):
        count = len(poses)
        if kernel["kind"] == "gaussian":
            noise = rng.standard_normal((count, 6), dtype=np.float32)
            return move(poses, self.scale(sigma * kernel["noise_scale"]) * noise, self.center)
        axes = np.float32(kernel["axes"])[rng.integers(3, size=count)]
        free = rng.random(count) < kernel["uniform_angle_probability"]
        angle = np.where(free, rng.uniform(0, 2 * np.pi, count), np.pi)
        angle = angle * (rng.random(count) < kernel["probability"])
        turn = np.float32(axes * angle[:, None])
        return move(poses, np.concatenate([np.zeros_like(turn), turn], 1), self.center)

    def rescore(self, scene, best, poses, weights, rng, top_k, pixels, sigma, **_):
        """The best of the estimate and the heaviest particles, by more points."""
        poses = np.concatenate([best[None], poses[np.argsort(-weights)[:top_k]]])
        scores = self.score(scene, poses, sigma, pixels, rng)
        return poses[scores.argmax()], scores.max()

    def shift(self, scene, best, poses, weights, rng, iterations, antithetic_pairs, start, end,
              sigma, pixels, **_):  # fmt: skip
        """Mean shift: the likelihood-weighted mean of pairs of opposite moves."""
        for index in range(iterations):
            spread = start * (end / start) ** (index / max(iterations - 1, 1))
            noise = rng.standard_normal((antithetic_pairs, 6), dtype=np.float32)
            moves = np.concatenate([noise, -noise]) * self.scale(spread)
            near = move(np.broadcast_to(best, (len(moves), 4, 4)), moves, self.center)
            weight = softmax(self.score(scene, near, sigma, pixels, rng))
            best = move(best[None], (weight[:, None] * moves).sum(0)[None], self.center)[0]
        return best, self.score(scene, best[None], sigma, pixels, rng)[0]

    def align(self, image, best, surface, iterations, initial_gate, final_gate, prior, noise,
              effective, **_):  # fmt: skip
        """ICP: lay the surface on the measured depth, with the estimate as a Gaussian prior."""
        pose, own, known = best.astype(float), np.array(surface), False
        precision = np.diag(self.scale(prior).astype(float) ** -2)
        moved = np.zeros(6)  # for turns as small as these, twists add up
        for index in range(iterations):
            share = index / max(iterations - 1, 1)
            width = initial_gate * (final_gate / initial_gate) ** share
            rows, along, weights = pair(image, pose, own, self.center, width)
            known = weights.sum() > 10
            if not known:
                continue
            weights = weights * min(1, effective / weights.sum()) / noise**2
            slope = rows.T @ (weights * along) - precision @ moved
            step = np.linalg.solve((rows.T * weights) @ rows + precision, slope)
            pose, moved = move(pose[None], step[None], self.center)[0], moved + step
        return np.float32(pose) if known else best


def pair(image, pose, own, center, width):
    """Point-to-plane distances of surface points (P, 3) to what is measured at their pixels.

    Returns derivatives by a move (P, 6), distances (P,) [m] and weights (P,).
    """
    depth, K, R = image["depth"], image["intrinsics"], pose[:3, :3]
    points, middle = own @ R.T + pose[:3, 3], R @ center + pose[:3, 3]
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    at = (points[:, :2] / points[:, 2:].clip(1e-3)) * [K[0, 0], K[1, 1]] + K[:2, 2]
    reach = max(1, round(0.004 * float(K[0, 0])))
    sides = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]]) * reach
    u, v = np.moveaxis(np.floor(at + 0.5).clip(-1e6, 1e6).astype(int)[:, None] + sides, -1, 0)
    inside = (u >= 0) & (u < depth.shape[1]) & (v >= 0) & (v < depth.shape[0])
    z = depth[v.clip(0, depth.shape[0] - 1), u.clip(0, depth.shape[1] - 1)] * inside
    seen = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(z)], -1)
    seen = seen * z[..., None]
    normal = np.cross(seen[:, 3] - seen[:, 4], seen[:, 1] - seen[:, 2])
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-12)
    normal = np.where((normal * seen[:, 0]).sum(1, keepdims=True) > 0, -normal, normal)
    bend = np.abs((z[:, 1::2] + z[:, 2::2]) / 2 - z[:, :1]).max(1)
    way = seen[:, 0] - points
    along = (way * normal).sum(1)
    counted = (z > 0).all(1) & (bend < 0.003 + 0.005 * z[:, 0]) & (points[:, 2] > 0.05)
    counted &= (((points - middle) * ray).sum(1) < 0) & ((normal * ray).sum(1) < -0.3)
    counted &= np.linalg.norm(way, axis=1) < 2.5 * width
    weights = (1 - (along / width) ** 2).clip(0) ** 2 * counted
    return np.concatenate([normal, np.cross(points - middle, normal) @ R], 1), along, weights


def draw_points(count, even, rng):
    """Standard normal points (count, 2), independent or from an even sequence, shifted."""
    if not even:
        return rng.standard_normal((count, 2), dtype=np.float32)
    step = [0.7548776662466927, 0.5698402909980532]
    square = (np.arange(count)[:, None] * step + rng.random(2)) % 1
    return np.float32(np.vectorize(NormalDist().inv_cdf)(square.clip(1e-7, 1 - 1e-7)))


def softmax(x):
    x = np.exp(x - x.max())
    return x / x.sum()


def resample(weights, count, rng):
    """Systematic resampling: the ancestors (count,) of equally weighted children."""
    at = (np.arange(count) + rng.random()) / count
    return np.searchsorted(np.cumsum(weights, dtype=float), at).clip(0, len(weights) - 1)


def move(poses, tangents, center):
    """Turn poses about the object's center, and shift them: (N, 4, 4), (N, 6) -> (N, 4, 4)."""
    x, y, z = tangents[:, 3:].T
    zero = np.zeros_like(x)
    K = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    angle = np.linalg.norm(tangents[:, 3:], axis=1)[:, None, None].clip(1e-6)
    turn = np.eye(3) + np.sin(angle) / angle * K + (1 - np.cos(angle)) / angle**2 * (K @ K)
    moved = poses.copy()
    moved[:, :3, :3] = poses[:, :3, :3] @ turn
    moved[:, :3, 3] += poses[:, :3, :3] @ center + tangents[:, :3] - moved[:, :3, :3] @ center
    return moved


def draw(weights, rng, *shape):
    """Draw indices by the last axis of weights: (*, n) -> (*, *shape)."""
    sums = np.cumsum(weights, axis=-1, dtype=float)
    at = rng.random((*weights.shape[:-1], *shape)) * sums[..., -1][(...,) + (None,) * len(shape)]
    sums = sums[(..., *(None,) * len(shape), slice(None))]
    return (sums <= at[..., None]).sum(-1).clip(0, weights.shape[-1] - 1)


def draw_poses(point, weight, share, position, center, radius, count, rng, votes=3):
    """Poses (count, 4, 4) by rigid fits to a seed and `votes` more correspondences near it."""
    weight = weight * share.max(-1)
    weight = weight if weight.any() else np.ones_like(weight)
    seed = draw(weight, rng, count)
    near = np.linalg.norm(point[seed][:, None] - point, axis=-1) < 2 * radius
    rest = draw(weight * near + 1e-12 * (weight > 0), rng, votes)
    first = position[seed, draw(share[seed], rng)]
    distance = np.linalg.norm(point[rest] - point[seed][:, None], axis=-1) / radius
    apart = np.linalg.norm(position[rest] - first[:, None, None], axis=-1)
    agreeing = share[rest] * (np.exp(-0.5 * ((apart - distance[..., None]) / 0.1) ** 2) + 1e-6)
    others = position[rest, draw(agreeing + 1e-30, rng)]
    index = np.concatenate([seed[:, None], rest], 1)
    found = np.concatenate([first[:, None], others], 1) * radius + center
    return fit_rigid(found, point[index], weight[index])


def fit_rigid(source, target, weights):
    """Kabsch's fit: (*, P, 3) x 2, (*, P) -> target_from_source (*, 4, 4)."""
    w = (weights / weights.sum(-1, keepdims=True).clip(1e-12))[..., None]
    mean_s, mean_t = (w * source).sum(-2, keepdims=True), (w * target).sum(-2, keepdims=True)
    U, _, Vh = np.linalg.svd(np.swapaxes((target - mean_t) * w, -1, -2) @ (source - mean_s))
    U[..., 2] *= np.sign(np.linalg.det(U @ Vh))[..., None]
    poses = np.zeros((*source.shape[:-2], 4, 4), np.float32)
    poses[..., :3, :3] = R = U @ Vh
    poses[..., :3, 3] = (mean_t - mean_s @ np.swapaxes(R, -1, -2))[..., 0, :]
    poses[..., 3, 3] = 1
    return poses


def read_arguments():
    """Folder, RGB (H, W, 3) uint8, depth (H, W) [m] and camera matrix of the command line."""
    import cv2

    folder, rgb, depth, intrinsics, scale = sys.argv[1:]
    fx, fy, cx, cy = map(float, intrinsics.split(","))
    color = cv2.cvtColor(cv2.imread(rgb), cv2.COLOR_BGR2RGB)
    z = cv2.imread(depth, cv2.IMREAD_UNCHANGED) / float(scale)
    return folder, color, z, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


if __name__ == "__main__":
    place, *images = read_arguments()
    pose, score, *_ = PoseFilter(place).estimate(*images)
    print(np.array2string(pose, precision=4, suppress_small=True), f"score {score:.2f}")
