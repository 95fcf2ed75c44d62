"""Tracking: a belief that is carried from frame to frame."""
