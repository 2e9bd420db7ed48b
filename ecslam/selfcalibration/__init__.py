"""What a depth camera is really like, found from a recording of it (ours): ``estimate.self_calibrate``."""

from .estimate import Found, self_calibrate

__all__ = ["Found", "self_calibrate"]
