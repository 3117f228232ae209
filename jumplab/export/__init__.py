"""Jumps for other programs: joint tables, plain arrays, clips for motion trackers, folders to replay.

>>> from jumplab import export
>>> from jumplab.motion import Motion
>>> export.write("csv", Motion.of(tape), robot, "joints.csv")
"""

from jumplab.export.clip import ORDERS, Clip, body_names, motion_clip
from jumplab.export.formats import CLIP_FPS, FORMATS, RATE_HZ, default_name, write

__all__ = ["CLIP_FPS", "FORMATS", "ORDERS", "RATE_HZ", "Clip", "body_names", "default_name", "motion_clip", "write"]
