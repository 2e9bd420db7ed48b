"""Small pictures for people: thumbnails and the six views of a frame."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ..messages import FramePictures

MAX_DIFFERENCE_M = 0.10
SCALE_TOP, SCALE_BOTTOM, SCALE_LEFT, SCALE_RIGHT = 4, 12, 12, 38  # pixels from the picture's top, left and right edge


def shrink(image: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    """A colour image at most ``width`` pixels wide, halved until it is: three times as quick as in one step."""
    while image.shape[1] > width:
        rows, columns = max(1, image.shape[0] // 2), image.shape[1] // 2
        whole = image[: 2 * rows, : 2 * columns]
        image = np.asarray(cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA), np.uint8)
    return image


def jpeg(image: NDArray[np.uint8]) -> bytes:
    """A colour image [h, w, 3] as a JPEG file."""
    _, encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])
    return encoded.tobytes()


def shrink_depth(depth: NDArray[np.float32], like: NDArray[np.uint8]) -> NDArray[np.float32]:
    """A depth image at the size of the picture ``like`` [h, w, 3]; nearest pixels, so that no depth is made up."""
    height, width = like.shape[:2]
    return np.asarray(cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST), np.float32)


def six_pictures(
    frame: int,
    color: NDArray[np.uint8],
    depth: NDArray[np.float32],
    color_rendered: NDArray[np.uint8],
    depth_rendered: NDArray[np.float32],
) -> FramePictures:
    """Input, rendered and difference, of colour [h, w, 3] and depth [h, w] (metres, 0 = none), all of one size."""
    has = depth > 0
    far = float(np.percentile(depth[has], 98)) if has.any() else 1.0
    gap = np.where(has, np.abs(depth - depth_rendered), 0)
    return FramePictures(
        frame=frame,
        color=color,
        color_rendered=color_rendered,
        color_difference=np.asarray(cv2.absdiff(color, color_rendered), np.uint8),
        depth=_tinted(depth / far, has),
        depth_rendered=_tinted(depth_rendered / far, depth_rendered > 0),
        depth_difference=with_scale(_tinted(gap / MAX_DIFFERENCE_M, has), f"{100 * MAX_DIFFERENCE_M:.0f} cm"),
    )


def with_scale(picture: NDArray[np.uint8], most: str) -> NDArray[np.uint8]:
    """A tinted picture [h, w, 3] whose top edge says which colours stand for 0 to ``most``."""
    out, right = picture.copy(), picture.shape[1] - SCALE_RIGHT
    out[: SCALE_TOP + SCALE_BOTTOM] = 0
    bar = out[SCALE_TOP:SCALE_BOTTOM, SCALE_LEFT:right]
    bar[:] = _tinted(np.linspace(0, 1, bar.shape[1])[None], np.ones((1, 1), bool))
    for text, x in (("0", 1), (most, right + 3)):
        cv2.putText(out, text, (x, SCALE_BOTTOM), cv2.FONT_HERSHEY_SIMPLEX, 0.33, (255, 255, 255), 1, cv2.LINE_AA)
    return out


def _tinted(share: NDArray[np.floating], valid: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Values 0..1 as colours; black where there is none."""
    level = (np.nan_to_num(share).clip(0, 1) * 255).astype(np.uint8)
    tinted = np.asarray(cv2.applyColorMap(level, cv2.COLORMAP_TURBO)[..., ::-1], np.uint8)
    return np.where(valid[..., None], tinted, np.uint8(0))
