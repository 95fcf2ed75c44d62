"""The task on SE(3) that filter cores are compared by: numbers alone, shared by all peers.

A pose walks at random: its translation by N(0, SHIFT^2) an axis, its rotation by the exponential of
N(0, TURN^2) about its own axes. What is observed of it is its translation, with noise NOISE an
axis, and how far its third axis leans, (1 - R_22) / LEAN, with noise 1. Particles are resampled in
every step, systematically. The first are drawn from the same walk, START times as wide, about the
first observation.
"""

SHIFT = 0.01  # [m]
RADIUS = 0.2  # [m]; posefilter's noise level of a turn is that of a shift over the radius
TURN = SHIFT / RADIUS  # [rad]
NOISE = 0.02  # [m]
LEAN = 0.3
START = 4.0
SMALL = 1e-4  # [rad]; below it a turn's sine is its angle


def observe(step: int) -> tuple[float, float, float]:
    """Return the observed translation of a step [m], on a slow circle."""
    import math

    return 0.05 * math.cos(0.1 * step), 0.05 * math.sin(0.1 * step), 1.0
