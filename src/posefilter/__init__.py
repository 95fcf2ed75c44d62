"""posefilter: 6-DoF object pose, and a belief over it, from RGB-D images with learned particle
filters.
"""

__version__ = "0.1.0"
