"""The neural TSDF map."""

from .grid import box_of_points, build_layout, grow_layout, regrow, table_rows
from .tsdf import TsdfField, create_field, grow_field, map_params

__all__ = [
    "TsdfField",
    "box_of_points",
    "build_layout",
    "create_field",
    "grow_field",
    "grow_layout",
    "map_params",
    "regrow",
    "table_rows",
]
