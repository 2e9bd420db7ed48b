"""Built-in furnished rooms, rendered on the fly with exact depth, poses and surface."""

from ..addresses import ROOMS
from .address import Address, parse_address
from .export import write_replica
from .sequence import SyntheticSequence, open_synthetic

__all__ = ["ROOMS", "Address", "SyntheticSequence", "open_synthetic", "parse_address", "write_replica"]
