"""Pure functions on tensors: rotations, rigid transforms, cameras and the spaces that particles
live in.
"""
