"""Synthetic scenes: placing, textures, sensor, writing them."""
