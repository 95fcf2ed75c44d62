"""Figures of what a filter sees and believes: arrays in, images out.

Nothing here knows Lightning.
"""
