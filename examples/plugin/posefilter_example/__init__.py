"""A loss, a likelihood, a reader and a method of one's own; importing it makes the reader known."""

from posefilter.data.readers.registry import register_reader
from posefilter_example.reader import NpzReader

register_reader("npz", NpzReader)
