"""The particle filter and the pieces that are injected into it."""
