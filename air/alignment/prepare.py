"""One photo made ready for alignment: decoded, judged, features found. Pure, so photos can be prepared in parallel."""

from __future__ import annotations

import hashlib
import io
from dataclasses import dataclass, replace

import cv2
import numpy as np
from PIL import Image, UnidentifiedImageError

from air.alignment.settings import AlignmentSettings
from common.arrays import F32, U8
from common.camera import CameraModel
from common.messages import Photo

MIN_FEATURES = 100
THUMBNAIL_PX = 320
ORDINARY_FOCAL = 0.8
"""Focal length per image width where a photo says nothing of its camera: a common wide lens."""


@dataclass(frozen=True, eq=False)
class Features:
    """Corners of one photo: `uv` (N, 2) float32 px of the full image and RootSIFT descriptors (N, 128) float32.

    Unit descriptors whose inner product is their similarity (Arandjelović and Zisserman, CVPR 2012).
    """

    uv: F32
    descriptors: F32

    def strongest(self, count: int) -> Features:
        """The first `count` features: they are sorted by strength."""
        return Features(self.uv[:count], self.descriptors[:count])


@dataclass(frozen=True, eq=False)
class PreparedPhoto:
    """A photo with its image (H, W, 3) uint8 RGB, camera guess and features, or with the reason why it is unusable."""

    photo: Photo
    camera: CameraModel | None
    image: U8 | None
    features: Features | None
    digest: bytes
    fault: str | None = None


def prepare(photo: Photo, settings: AlignmentSettings) -> PreparedPhoto:
    """The photo ready for alignment; never raises: a photo that cannot serve says so in `fault`."""
    digest = hashlib.sha256(photo.jpeg).digest()
    image = decode_jpeg(photo.jpeg)
    if image is None:
        return PreparedPhoto(photo, None, None, None, digest, "the file is truncated or is not an image")
    features = detect(image, settings)
    if len(features.uv) < MIN_FEATURES:
        fault = f"only {len(features.uv)} features: black, blurred or without texture"
        return PreparedPhoto(photo, None, None, None, digest, fault)
    height, width = image.shape[:2]
    return PreparedPhoto(photo, fitted_camera(photo.camera, width, height), image, features, digest)


def fitted_camera(camera: CameraModel | None, width: int, height: int) -> CameraModel:
    """The camera guess for an image of this size; a guess made for another size is scaled to it."""
    if camera is None:
        f = ORDINARY_FOCAL * width
        return CameraModel(width, height, f, f, (width - 1) / 2, (height - 1) / 2)
    if (camera.width, camera.height) == (width, height):
        return camera
    return replace(camera.scaled(width / camera.width), width=width, height=height)


def decode_jpeg(jpeg: bytes) -> U8 | None:
    """Image (H, W, 3) uint8 RGB, or None when the bytes are damaged, truncated or no image."""
    try:
        with Image.open(io.BytesIO(jpeg)) as image:
            return np.asarray(image.convert("RGB"))
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None


def detect(image: U8, settings: AlignmentSettings) -> Features:
    """SIFT features of an RGB image (H, W, 3), strongest first, at most `settings.features`."""
    scale = min(1.0, settings.working_px / max(image.shape[:2]))
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    if scale < 1.0:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    sift = cv2.SIFT_create(nfeatures=settings.features, contrastThreshold=0.02)
    keypoints, descriptors = sift.detectAndCompute(grey, None)
    if descriptors is None:
        return Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32))
    strongest = np.argsort([-k.response for k in keypoints], kind="stable")
    uv, descriptors = np.array([k.pt for k in keypoints], np.float32)[strongest], descriptors[strongest]
    # SIFT gives a second orientation its own feature at the same place: keep one, tracks need distinct features.
    _, first = np.unique(uv, axis=0, return_index=True)
    first.sort()
    uv, descriptors = uv[first][: settings.features], descriptors[first][: settings.features]
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
    return Features(((uv + 0.5) / scale - 0.5).astype(np.float32), root.astype(np.float32))


def thumbnail(image: U8) -> bytes:
    """A small JPEG of an RGB image (H, W, 3)."""
    scale = THUMBNAIL_PX / max(image.shape[:2])
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 80])
    return bytes(jpeg.tobytes())
