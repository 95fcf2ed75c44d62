"""Pure functions on tensors: rotations, rigid transforms, cameras, and the spaces of particles."""
