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


class ImageError(ValueError):
    """An image that no pose can be estimated in, as of a covered sensor; the next one may do."""


def take_image(settings, rgb, depth, intrinsics):
    """An image as `encode` reads it: RGB (H, W, 3) uint8, depth (H, W) [m], (3, 3)."""
    size = (settings["camera"][1], settings["camera"][0])
    if rgb.dtype != np.uint8 or rgb.shape[2:] != (3,):
        raise ImageError(f"the image is {rgb.dtype} {rgb.shape}; expected uint8 (H, W, 3), RGB")
    if depth.shape != rgb.shape[:2]:
        color, deep = ("x".join(map(str, x.shape[1::-1])) for x in (rgb, depth))
        raise ImageError(f"the image has {color} pixels, its depth {deep}")
    if depth.shape != size:
        raise ImageError(f"exported for images of {size[1]}x{size[0]}: export with width=, height=")
    depth = np.float32(np.where(depth < 100, depth, 0))  # what is farther is not measured
    known = depth[depth > 0]
    if not len(known) or not 0.05 <= np.median(known) <= 30:
        raise ImageError("depth: no pixel has any, or it is not in meters")
    return {"rgb": rgb, "depth": depth, "intrinsics": np.float32(intrinsics)}


class PoseFilter:
    """What `export.py format=onnx` wrote of a `pose_pf`."""

    def __init__(self, folder, threads=1):
        self.settings, self.encode, self.measure = open_export(folder, threads)
        self.center, self.radius = np.float32(self.settings["center"]), self.settings["radius"]

    def estimate(self, rgb, depth, intrinsics, seed=0):
        """RGB (H, W, 3) uint8, depth (H, W) [m], (3, 3) -> camera_from_object (4, 4), its score,
        and the belief: poses (N, 4, 4), weights (N,).
        """
        image = take_image(self.settings, rgb, depth, intrinsics)
        return self.search(image, np.random.default_rng(seed), self.settings.get("zoom"))

    def search(self, image, rng, zoom):
        """Run the filter on an image; with `zoom`, on a magnified window if the object is small."""
        s, names = self.settings, [output.name for output in self.encode.get_outputs()]
        encoding = dict(zip(names, self.encode.run(names, image), strict=True))
        poses = draw_poses(*(encoding[name] for name in ("point", "weight", "share", "position")),
                           self.center, self.radius, s["first_particles"], rng)  # fmt: skip
        weights = np.ones(len(poses)) / len(poses)
        for number, sigma in enumerate(s["levels"]):
            if number:
                if s["resample"] == "systematic":
                    poses = poses[resample(weights, s["particles"], rng)]
                for kernel in s["propagate"]:
                    poses = self.propagate(poses, kernel, sigma, rng)
            scores = self.score(encoding, poses, sigma, s["points"], rng)
            weights = softmax(scores)
            if zoom and number + 1 == zoom["steps"]:  # is it small where the particles agree?
                window = self.magnify(image, poses, weights, **zoom)
                if window:
                    return self.search(window, rng, None)
        best, score = poses[scores.argmax()], scores.max()
        for step in s["refine"]:
            if step["kind"] == "icp":
                best = self.align(image, best, **step)
                continue
            if step["kind"] == "texture":
                best, poses = self.turn(encoding, image, best, poses, rng, **step)
                continue
            if step["kind"] == "texture_alignment":
                best = self.align_print(image, best, **step)
                continue
            refine = self.rescore if step["kind"] == "rescore" else self.shift
            best, score = refine(encoding, best, poses, weights, rng, **step)
        window = self.magnify(image, best[None], np.ones(1), **zoom) if zoom else None
        return self.search(window, rng, None) if window else (best, float(score), poses, weights)

    def magnify(self, image, poses, weights, diameter, least, most, heaviest, agreed,
                least_depth, **_):  # fmt: skip
        """A window about the place with the most weight within half a diameter, as an image of
        another camera; None where that is too little weight, the object is not small there, or
        hardly a pixel has depth.
        """
        own, K = self.settings["diameter"], image["intrinsics"].copy()
        centers = poses[:, :3, :3] @ self.center + poses[:, :3, 3]
        some = centers[np.argsort(-weights)[:heaviest], None]
        near = (np.linalg.norm(some - centers, axis=-1) < own / 2) * weights
        near = near[near.sum(1).argmax()]
        center = near @ centers / near.sum()
        size = np.array(image["depth"].shape[::-1])
        zoom = min(diameter * size[0] * center[2] / (K[0, 0] * own), most)
        if near.sum() < agreed or zoom < least:
            return None
        count = np.round(size / zoom).astype(int)
        pixel = K.diagonal()[:2] * center[:2] / center[2] + K[:2, 2]
        first = np.round(pixel - (count - 1) / 2).astype(int).clip(0, size - count)
        (left, top), (right, bottom) = first, first + count
        rgb, depth = (image[name][top:bottom, left:right] for name in ("rgb", "depth"))
        if (depth > 0).mean() < least_depth:
            return None
        at = np.stack(np.meshgrid(*map(np.arange, size)), -1)
        at = ((at + 0.5) * count / size - 0.5).clip(0, count - 1)
        K[:2, 2] += 0.5 - first
        K[:2] *= (size / count)[:, None]
        K[:2, 2] -= 0.5
        rgb = np.uint8(look(rgb, at) + 0.5)
        return {"rgb": rgb, "depth": look_at_depth(depth, at), "intrinsics": K}

    def score(self, encoding, poses, sigma, points, rng):
        """Log-likelihoods (N,) at a noise level [m], from so many image points."""
        noise = draw_points(points, self.settings["quasi_monte_carlo"], rng)
        given = {"poses": poses, "sigma": np.array(sigma, np.float32), "noise": noise, **encoding}
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

    def rescore(self, encoding, best, poses, weights, rng, top_k, pixels, sigma, **_):
        """The best of the estimate and the heaviest particles, by more points."""
        poses = np.concatenate([best[None], poses[np.argsort(-weights)[:top_k]]])
        scores = self.score(encoding, poses, sigma, pixels, rng)
        return poses[scores.argmax()], scores.max()

    def shift(self, encoding, best, poses, weights, rng, iterations, antithetic_pairs,
              initial_scale, final_scale, sigma, pixels, **_):  # fmt: skip
        """Mean shift: the likelihood-weighted mean of pairs of opposite moves."""
        for index in range(iterations):
            share = index / max(iterations - 1, 1)
            spread = initial_scale * (final_scale / initial_scale) ** share
            noise = rng.standard_normal((antithetic_pairs, 6), dtype=np.float32)
            moves = np.concatenate([noise, -noise]) * self.scale(spread)
            near = move(np.broadcast_to(best, (len(moves), 4, 4)), moves, self.center)
            weight = softmax(self.score(encoding, near, sigma, pixels, rng))
            best = move(best[None], (weight[:, None] * moves).sum(0)[None], self.center)[0]
        return best, self.score(encoding, best[None], sigma, pixels, rng)[0]

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

    def align_print(self, image, best, surface, spacing, sides, iterations, initial_blur, prior,
                    gate, noise, effective, min_gain, **step):  # fmt: skip
        """Move the estimate so that its print lies on the image's, and its surface on the depth."""
        pose, known, moved = best.astype(float), False, np.zeros(6)
        surface, own = np.array(surface), np.split(np.array(step["print"]), 3, axis=1)
        precision = np.diag(self.scale(prior).astype(float) ** -2)
        size = self.settings["diameter"]
        for index in range(iterations):
            rows, along, weights = pair(image, pose, surface, self.center, gate)
            weights = weights * min(1, effective / max(weights.sum(), 10)) / noise**2
            information, slope = (rows.T * weights) @ rows, rows.T @ (weights * along)
            blurred = initial_blur ** (1 - (index + 1) / iterations)
            term = read_print(image, pose, own, np.array(sides), self.center, spacing, size,
                              blurred, **step)  # fmt: skip
            known = term is not None
            if known:
                information, slope = information + term[0], slope + term[1]
            twist = np.linalg.solve(information + precision, slope - precision @ moved)
            pose, moved = move(pose[None], twist[None], self.center)[0], moved + twist
        both = np.stack([best, np.float32(pose)])
        fits = compare(image, both, own, self.center, spacing, size, True)
        return both[1] if known and fits[1] - fits[0] > min_gain else best

    def turn(self, encoding, image, best, poses, rng, turns, coarse, surface, spacing,
             learned_weight, pixels, sigma, **_):  # fmt: skip
        """Turn the estimate and the particles as the object's print says."""
        turns = np.float32(np.pad(np.reshape(turns, (-1, 3, 4)), ((0, 0), (0, 1), (0, 0))))
        turns[:, 3, 3] = 1
        some, size = turns[coarse], self.settings["diameter"]
        own = np.split(np.array(surface), 3, axis=1)

        def weigh(some_poses, still):
            return compare(image, some_poses, own, self.center, spacing, size, still)

        learned = learned_weight * self.score(encoding, best @ some, sigma, pixels, rng)
        total = learned + weigh(best @ some, len(some) > 12)
        tried = np.array(coarse)
        if len(some) > 12:  # the best are compared at the best turn beside each
            top = np.argsort(-total)[:12]
            trace = np.einsum("sij,tij->st", some[top, :3, :3], turns[:, :3, :3])
            beside = np.argsort(-trace, axis=1)[:, :5]
            fine = weigh((best @ turns[beside]).reshape(-1, 4, 4), True).reshape(12, 5)
            tried[top] = beside[np.arange(12), fine.argmax(1)]
            total[top] = learned[top] + weigh(best @ turns[tried[top]], False)
        chosen = turns[tried[total.argmax()]]
        cosine = (np.einsum("sij,ij->s", turns[:, :3, :3], chosen[:3, :3]) - 1) / 2
        near = best @ turns[np.degrees(np.arccos(cosine.clip(-1, 1))) < 10]
        found = near[weigh(near, False).argmax()] if len(near) > 1 else best @ chosen
        apart = distance(poses[:, None], best @ some, self.center, self.radius)
        at, share = apart.argmin(1), (rng.permutation(len(poses)) + rng.random()) / len(poses)
        drawn = np.searchsorted(np.cumsum(softmax(total)), share).clip(0, len(some) - 1)
        moved = poses @ np.linalg.inv(some)[at] @ turns[tried[drawn]]
        return found, np.where((apart.min(1) < 0.2 * size)[:, None, None], moved, poses)


def compare(image, poses, own, center, spacing, size, still):
    """How much better the print explains the image than plain shading does: (C,) [nat]."""
    K, depth = image["intrinsics"], image["depth"]
    own, normal, color = own
    R, focal = poses[:, :3, :3].astype(float), float(K[0, 0])
    points = own @ R.transpose(0, 2, 1) + poses[:, None, :3, 3]
    normals = normal @ R.transpose(0, 2, 1)
    cosine = -(normals * points).sum(-1) / np.linalg.norm(points, axis=-1)
    at = points[..., :2] / points[..., 2:].clip(1e-3) * [K[0, 0], K[1, 1]] + K[:2, 2]
    u, v = np.moveaxis(np.floor(at + 0.5).clip(-1e6, 1e6).astype(int), -1, 0)
    high, wide = depth.shape
    z = depth[v.clip(0, high - 1), u.clip(0, wide - 1)]
    z = z * ((u >= 0) & (u < wide) & (v >= 0) & (v < high))
    seen = (z > 0) & (np.abs(z - points[..., 2]) < 0.004 + 0.03 * size) & (cosine > 0.25)
    weight = seen * cosine
    covered = (weight * (spacing * focal / points[..., 2].clip(0.05)) ** 2).sum(-1)
    count = 0.4 * np.minimum(seen.sum(-1), covered / 2)
    basis = np.concatenate([np.ones_like(cosine)[..., None], normals], -1)
    middle = np.median((R @ center + poses[:, :3, 3])[:, 2]).clip(0.05)
    shown = np.log(blur(image["rgb"] / 255, max(0.5, 0.33 * spacing * focal / middle)) + 0.03)
    x, best = leave(np.broadcast_to(color, points.shape), basis, weight), np.zeros(len(poses))
    for offset in np.indices((3, 3)).reshape(2, 9).T - 1 if not still else np.zeros((1, 2)):
        y = leave(look(shown, at + 0.002 * focal * offset), basis, weight)
        xy, xx, yy = ((weight[..., None] * one).sum((1, 2)) for one in (x * y, x * x, y * y))
        best = np.maximum(best, xy / np.sqrt(xx * yy).clip(1e-9))
    return -0.5 * count * np.log1p(-(best.clip(0, 0.99) ** 2))


def read_print(image, pose, own, sides, center, spacing, size, blurred, independent,
               min_correlation, texture_error, **_):  # fmt: skip
    """What the colors say of a pose's move: a matrix (6, 6) and a right side (6,), or nothing.

    A Gauss-Newton step of y = shading + gain x, with the print of each side shifted a little.
    """
    K, depth, R = image["intrinsics"].astype(float), image["depth"], pose[:3, :3]
    points, normals = own[0] @ R.T + pose[:3, 3], own[1] @ R.T
    cosine = -(normals * points).sum(1) / np.linalg.norm(points, axis=1)
    at = points[:, :2] / points[:, 2:].clip(1e-3) * [K[0, 0], K[1, 1]] + K[:2, 2]
    edge = np.array(depth.shape[::-1]) - 3
    u, v = np.floor(at + 0.5).clip(0, edge + 2).astype(int).T
    z = depth[v, u]
    seen = (z > 0) & (np.abs(z - points[:, 2]) < 0.004 + 0.03 * size) & (cosine > 0.25)
    seen &= ((at > 2) & (at < edge)).all(1)
    if seen.sum() < 30:
        return None
    points, normals, cosine, at = points[seen], normals[seen], cosine[seen], at[seen]
    middle, focal = R @ center + pose[:3, 3], K[0, 0]
    sigma = blurred * max(0.5, 0.33 * spacing * focal / middle[2])
    shown = np.log(blur(image["rgb"] / 255, sigma) + 0.03)
    y, halves = look(shown, at), 0.5 * np.eye(2)
    along = np.stack([look(shown, at + half) - look(shown, at - half) for half in halves], -1)
    basis, weights = np.concatenate([np.ones((len(at), 1)), normals], 1), cosine
    both = np.concatenate([own[2][seen], y], 1)
    for again in (True, True, False):  # points that do not fit lose their weight
        x, y = np.split(leave(both[None], basis[None], weights[None])[0], 2, axis=1)
        power = weights[:, None] * x
        gain = (power * y).sum() / (power * x).sum().clip(1e-12)
        if again:
            left = y - gain * x
            spread = max(0.01, 1.4826 * np.sort(np.abs(left), None)[(left.size - 1) // 2])
            weights = cosine / (1 + (left**2).mean(1) / (2 * spread) ** 2)
    energy = (power * x).sum() * (weights[:, None] * y**2).sum()
    if not (power * y).sum() > min_correlation * np.sqrt(energy):
        return None
    by_point = np.zeros((len(at), 2, 3))
    by_point[:, 0, 0], by_point[:, 1, 1] = K[0, 0] / points[:, 2], K[1, 1] / points[:, 2]
    by_point[:, :, 2] = -points[:, :2] * [K[0, 0], K[1, 1]] / points[:, 2:] ** 2
    by_turn = np.cross((points - middle)[:, None], by_point) @ R
    by_shift = np.eye(6)[sides[seen]][:, None, :, None] * (by_point @ R)[:, :, None]
    rows = along @ np.concatenate([by_point, by_turn, by_shift.reshape(len(at), 2, 18)], 2)
    rows = leave(rows.reshape(1, len(at), 72), basis[None], weights[None])[0]
    rows = rows.reshape(len(at), 3, 24)
    rows = rows - x[..., None] * ((power[..., None] * rows).sum((0, 1)) / (power * x).sum())
    left = y - gain * x
    variance = (weights[:, None] * left**2).sum() / (3 * weights.sum())
    covered = (weights * (spacing * focal / points[:, 2]) ** 2).sum()
    count = min(len(at), covered / (2 * max(1, sigma**2)))
    scale = independent * count / len(at) / max(variance, 0.01**2)
    weighted = scale * rows * weights[:, None, None]
    information = np.einsum("ncd,nce->de", weighted, rows)
    slope = -np.einsum("ncd,nc->d", weighted, left)
    own_shifts = information[6:, 6:] + np.eye(18) / texture_error**2
    part = np.linalg.solve(own_shifts, information[6:, :6]).T
    return information[:6, :6] - part @ information[6:, :6], slope[:6] - part @ slope[6:]


def leave(values, basis, weight):
    """What a weighted regression on a basis leaves: (C, P, 3), (C, P, 4), (C, P)."""
    weighted = (basis * weight[..., None]).transpose(0, 2, 1)
    ridge = (1e-6 * weight.sum(-1) + 1e-9)[:, None, None] * np.eye(4)
    return values - basis @ np.linalg.solve(weighted @ basis + ridge, weighted @ values)


def blur(image, sigma):
    """A Gaussian blur that repeats the edge: (H, W, 3), [px]."""
    half = min(max(1, round(3 * sigma)), min(image.shape[:2]) - 1)
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) / sigma) ** 2)
    for axis in (0, 1):
        padded = np.pad(image, [(half, half) if i == axis else (0, 0) for i in range(3)], "edge")
        parts = (np.take(padded, range(i, i + image.shape[axis]), axis) * w
                 for i, w in enumerate(kernel / kernel.sum()))  # fmt: skip
        image = sum(parts)
    return image


def look(image, at):
    """Sample an image bilinearly, 0 outside: (H, W, 3), (*, 2) [px] -> (*, 3)."""
    at = at.clip(-1e6, 1e6)
    left, value = np.floor(at).astype(int), 0
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        u, v = left[..., 0] + i, left[..., 1] + j
        inside = (u >= 0) & (u < image.shape[1]) & (v >= 0) & (v < image.shape[0])
        share = (1 - np.abs(at - np.stack([u, v], -1))).prod(-1) * inside
        value = value + share[..., None] * image[v.clip(0, image.shape[0] - 1),
                                                 u.clip(0, image.shape[1] - 1)]  # fmt: skip
    return value


def look_at_depth(depth, at):
    """Sample depth bilinearly within a surface, else take the nearest: (H, W), (*, 2) -> (*)."""
    u, v = np.moveaxis(np.minimum(at.astype(int), np.array(depth.shape)[::-1] - 2), -1, 0)
    four = [depth[v + j, u + i] for i in (0, 1) for j in (0, 1)]
    low, high = np.min(four, 0), np.max(four, 0)
    u, v = np.moveaxis(np.ceil(at - 0.5).astype(int), -1, 0)
    between = look(depth[..., None], at)[..., 0]
    return np.float32(np.where((low > 0) & (high - low <= 0.02 * low), between, depth[v, u]))


def distance(a, b, center, radius):
    """How far poses are apart: (*, 4, 4) [m] twice; a turn counts as the shift at the radius."""
    shift = np.linalg.norm((a[..., :3, :3] - b[..., :3, :3]) @ center
                           + a[..., :3, 3] - b[..., :3, 3], axis=-1)  # fmt: skip
    trace = np.einsum("...ij,...ij->...", a[..., :3, :3], b[..., :3, :3])
    return np.hypot(shift, radius * np.arccos(((trace - 1) / 2).clip(-1, 1)))


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


def read_arguments(particles):
    """Folder, RGB (H, W, 3) uint8, depth (H, W) [m] and camera matrix of the command line, for a
    filter whose particles are "poses" or "pixels".
    """
    import cv2

    if len(sys.argv) != 6:
        sys.exit(f"usage: {particles}.py FOLDER RGB DEPTH fx,fy,cx,cy DEPTH_UNITS_A_METER")
    folder, rgb, depth, intrinsics, scale = sys.argv[1:]
    files = "filter.json", "encode.onnx", "measure.onnx"
    if not all((Path(folder) / name).is_file() for name in files):
        sys.exit(f"{folder}: no folder that export.py format=onnx wrote")
    own = json.loads((Path(folder) / "filter.json").read_text())["particles_are"]
    if own != particles:
        sys.exit(f"{folder}: its particles are {own}; {own}.py runs it")
    try:
        fx, fy, cx, cy = map(float, intrinsics.split(","))
        units = float(scale)
    except ValueError:
        sys.exit(f"{intrinsics} {scale}: expected fx,fy,cx,cy [px] and the units in a meter")
    if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0 and fy > 0):
        sys.exit(f"{intrinsics}: fx and fy must be above 0, and all four be numbers")
    if not 0 < units < np.inf:
        sys.exit(f"{scale}: expected the depth image's units in a meter, above 0")
    color = cv2.imread(rgb, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    z = cv2.imread(depth, cv2.IMREAD_UNCHANGED)
    for name, image in ((rgb, color), (depth, z)):
        if image is None:
            sys.exit(f"{name}: no image that OpenCV reads")
    if z.ndim != 2:
        sys.exit(f"{depth}: has {z.shape[2]} channels, and depth has one")
    if z.dtype == np.uint16:
        z[z == 65535] = 0  # saturated, and no measurement
        z = z / units
    elif z.dtype != np.float32:
        sys.exit(f"{depth}: is of {z.dtype}; depth is uint16, or float32 in meters")
    z = np.where(np.isfinite(z), z, 0)
    if not z.any():
        sys.exit(f"{depth}: no pixel has depth")
    color = cv2.cvtColor(color, cv2.COLOR_BGR2RGB)
    if not 0.05 <= (median := np.median(z[z > 0])) <= 30:
        sys.exit(f"{scale}: the median depth would be {median:.3g} m; is it 1000 or 10000?")
    return folder, color, z, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def print_estimate(particle_filter, images):
    """Print the pose of a `PoseFilter` or a `PixelFilter`."""
    try:
        pose, score, *_ = particle_filter.estimate(*images)
    except ImageError as error:
        sys.exit(str(error))
    print(np.array2string(pose, precision=4, suppress_small=True), f"score {score:.2f}")


if __name__ == "__main__":
    place, *images = read_arguments("poses")
    print_estimate(PoseFilter(place), images)
