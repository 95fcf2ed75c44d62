"""Mesh files, stores of meshes, symmetries."""
