"""What the runtime asks of the engine proper, so that tests can drive it with another one."""

from __future__ import annotations

import gc
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..config import Config
from ..messages import StepReport
from ..types import Frame, InputError, Intrinsics

State = dict[str, NDArray[Any]]

BASE_MB = 1000.0  # the library's own share, the fused volume, stored pixels, and what recorded loops keep
COPIES = 5  # of what is learnt: itself, its gradient, two moments, a frozen copy


class Abandoned(Exception):
    """Raised by the ``interrupt`` that ``SlamLike`` is given, through its ``step`` or ``finish``, to leave early."""


class TrajectoryLike(Protocol):
    """The part of ``ecslam.trajectory.Trajectory`` that is read here."""

    @property
    def timestamps(self) -> Sequence[float]:
        """Seconds, of all frames."""
        ...

    def poses(self) -> NDArray[np.float64]:
        """Poses [n, 4, 4] of all frames."""
        ...


class FieldLike(Protocol):
    """The part of ``ecslam.field.TsdfField`` that is read here."""

    @property
    def parameters(self) -> int:
        """How many learnt numbers there are."""
        ...


class SlamLike(Protocol):
    """The part of ``ecslam.slam.Slam`` that the runtime drives; see there."""

    kernels_name: str
    kernels_note: str

    @property
    def trajectory(self) -> TrajectoryLike:
        """Poses of the frames so far."""
        ...

    @property
    def field(self) -> FieldLike | None:
        """The map, or None before the first frame's mapping has begun. With a map, ``query`` and ``render`` work."""
        ...

    def step(self, frame: Frame, interrupt: Callable[[], None] | None = None, then: Frame | None = None) -> StepReport:
        """Process a frame; ``interrupt`` is called inside long loops and may raise to abandon it. then: the next one,
        where it is known already."""
        ...

    def finish(self, interrupt: Callable[[], None] | None = None) -> None:
        """The last mapping; ``interrupt`` as in ``step``."""
        ...

    def surface_points(self, limit: int) -> Callable[[], NDArray[np.float32]]:
        """At most about ``limit`` measured points [N, 3] in the world as it is now, for any thread to work out."""
        ...

    def query(self) -> tuple[Callable[[NDArray[np.float32]], Any], Callable[[NDArray[np.float32]], NDArray[np.uint8]]]:
        """TSDF and colour over a frozen copy of the map."""
        ...

    def render(
        self, c2w: NDArray[np.float64], depth: NDArray[np.float32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Colour and depth at the size of ``depth``."""
        ...

    def configure(self, config: Config) -> None:
        """Other tracking and mapping settings from the next frame on."""
        ...

    def state(self) -> State:
        """Everything that ``restore`` needs; arrays that nobody writes to afterwards."""
        ...


class SlamFactory(Protocol):
    """Makes the engine proper, fresh or, with ``state``, as it was when that was taken."""

    def __call__(
        self,
        config: Config,
        intrinsics: Intrinsics,
        *,
        device: str,
        bounds: NDArray[np.float64] | None,
        first_pose: NDArray[np.float64] | None,
        state: State | None,
    ) -> SlamLike:
        """See the class."""
        ...


@cache
def import_slam() -> None:
    """Import what ``make_slam`` needs, which takes seconds; any thread may do so ahead of it. No search for garbage
    goes through all that, then or later, which takes a tenth of a second each time."""
    gc.disable()
    try:
        from .. import slam as slam
    finally:
        gc.enable()
    gc.freeze()


def make_slam(
    config: Config,
    intrinsics: Intrinsics,
    *,
    device: str,
    bounds: NDArray[np.float64] | None,
    first_pose: NDArray[np.float64] | None,
    state: State | None,
) -> SlamLike:
    """The ``SlamFactory`` of ``ecslam.slam.Slam``. torch is imported here and not before."""
    import_slam()
    import torch

    from ..slam import Slam

    place = torch.device(device)
    if state is not None:
        return Slam.restore(config, intrinsics, state, device=place)
    return Slam(config, intrinsics, device=place, bounds=bounds, first_pose=first_pose)


def estimate_mb(config: Config) -> float:
    """About how much memory of a GPU a run takes, in 10^6 bytes: what is learnt, and the samples of an iteration."""
    field, sampling = config.field, config.sampling
    learnt = 4 * COPIES * 2 * field.levels * 2**field.log2_table_size
    rays = max(config.mapping.rays, config.tracking.rays)
    each = 4 * (4 * field.levels + 6 * field.blob_bins + 128)
    return BASE_MB + (learnt + each * rays * (sampling.uniform + sampling.near_depth)) / 1e6


def out_of_memory(error: BaseException, config: Config, device: str) -> InputError | None:
    """What to do about a GPU's lack of memory; None for any other error."""
    if type(error).__name__ != "OutOfMemoryError":
        return None
    return InputError(
        f"{device}: out of memory; preset {config.preset} needs about {estimate_mb(config):.0f} MB; free some, or "
        "use --device cpu (ecslam resume goes on from the last checkpoint)"
    )
