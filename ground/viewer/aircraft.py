"""Drawing of the aircraft, the path it came and the places of its photos, in one browser."""

from __future__ import annotations

import cv2
import numpy as np
import viser

from common.arrays import F64, U8
from common.se3 import SE3
from ground.cloud import FlightId, HeldKeyframe
from ground.viewer.scene import Aircraft, Scene, node_name

ACCENT = (255, 146, 43)
PHOTO_BLUE = (77, 171, 247)
WITH_IMAGE = 12
"""So many of the newest photos of a flight carry their picture; the older ones are outlines in one node."""
_PATH_POINTS = 4_000
_FRUSTUM_DEPTH = 3.0
_LEAST_ON_SCREEN = 0.016
_FRUSTUM_EDGES = ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1))


class AircraftDrawing:
    """Keeps one browser's nodes of aircraft, paths and photos equal to the scene, sending only what changed."""

    def __init__(self, api: viser.SceneApi) -> None:
        self._api = api
        self._frames: dict[FlightId, viser.FrameHandle] = {}
        self._origins: dict[FlightId, F64] = {}
        self._sent: dict[str, object] = {}
        self._nodes: dict[str, viser.SceneNodeHandle] = {}

    def update(self, scene: Scene, p_view: F64, photos: bool) -> None:
        """Bring the drawing up to date for a camera at `p_view` (3,) m in the scene, with or without the photos."""
        for aircraft in scene.aircraft:
            T_scene_world = scene.T_scene_world(aircraft.flight)
            if T_scene_world is not None:
                self._draw_aircraft(aircraft, T_scene_world, p_view)
                self._draw_path(aircraft, T_scene_world)
        by_flight: dict[FlightId, list[HeldKeyframe]] = {}
        for kept in scene.keyframes if photos else ():
            by_flight.setdefault(kept.flight, []).append(kept)
        wanted: set[str] = set()
        for flight, keyframes in by_flight.items():
            T_scene_world = scene.T_scene_world(flight)
            if T_scene_world is not None:
                wanted |= self._draw_photos(flight, keyframes, T_scene_world)
        for name in [name for name in self._nodes if name.startswith("/photos/") and name not in wanted]:
            self._nodes.pop(name).remove()
            del self._sent[name]

    def _draw_aircraft(self, aircraft: Aircraft, T_scene_world: SE3, p_view: F64) -> None:
        T_scene_body = T_scene_world @ aircraft.pose.T_world_body
        frame = self._frames.get(aircraft.flight)
        if frame is None:
            frame = self._api.add_frame(f"/aircraft/{node_name(aircraft.flight)}", show_axes=False)
            points, colours = _multirotor()
            self._api.add_line_segments(f"{frame.name}/body", points, colours, thickness=3.0, thickness_units="screen")
            name = f"{frame.name}/label"
            self._api.add_label(name, aircraft.flight.vehicle, position=(0.0, 0.0, 1.2), anchor="bottom-center")
            self._frames[aircraft.flight] = frame
        frame.position, frame.wxyz = tuple(T_scene_body.t), tuple(T_scene_body.wxyz)
        frame.scale = max(1.0, _LEAST_ON_SCREEN * float(np.linalg.norm(T_scene_body.t - p_view)))
        frame.visible = aircraft.alive or aircraft.pose_age_s < 60

    def _draw_path(self, aircraft: Aircraft, T_scene_world: SE3) -> None:
        path = aircraft.path
        if len(path) < 2:
            return
        # A long path is thinned, but its end stays at the aircraft.
        path = path[:: -(len(path) // _PATH_POINTS + 1)][::-1]
        if self._unchanged(f"/path/{node_name(aircraft.flight)}", (len(aircraft.path), *aircraft.path[-1])):
            return
        # The browser may apply a new position of a node before or after its new points: it must not change.
        origin = self._origins.setdefault(aircraft.flight, path[0])
        local = path - origin
        self._nodes[f"/path/{node_name(aircraft.flight)}"] = self._api.add_line_segments(
            f"/path/{node_name(aircraft.flight)}",
            np.stack([local[:-1], local[1:]], axis=1),
            np.array(ACCENT, np.uint8),
            thickness=2.0,
            thickness_units="screen",
            position=tuple(T_scene_world.apply(origin)),
            wxyz=tuple(T_scene_world.wxyz),
        )

    def _draw_photos(self, flight: FlightId, keyframes: list[HeldKeyframe], T_scene_world: SE3) -> set[str]:
        """Names of the nodes that stand for the photos of a flight."""
        outlines = f"/photos/{node_name(flight)}/older"
        recent, older = keyframes[-WITH_IMAGE:], keyframes[:-WITH_IMAGE]
        names = {self._draw_photo(kept, T_scene_world) for kept in recent}
        if older:
            names.add(outlines)
            if not self._unchanged(outlines, [(k.keyframe.index, k.keyframe.revision) for k in older]):
                origin = self._origins.setdefault(flight, older[0].keyframe.T_world_cam.t)
                self._nodes[outlines] = self._api.add_line_segments(
                    outlines,
                    np.concatenate([_frustum(kept) - origin for kept in older]),
                    np.array(PHOTO_BLUE, np.uint8),
                    thickness=1.0,
                    thickness_units="screen",
                    position=tuple(T_scene_world.apply(origin)),
                    wxyz=tuple(T_scene_world.wxyz),
                )
        return names

    def _draw_photo(self, kept: HeldKeyframe, T_scene_world: SE3) -> str:
        keyframe, camera = kept.keyframe, kept.keyframe.camera
        name = f"/photos/{node_name(kept.flight)}/{keyframe.index}"
        if self._unchanged(name, keyframe.revision):
            return name
        T_scene_cam = T_scene_world @ keyframe.T_world_cam
        node = self._nodes.get(name)
        if node is not None:
            node.position, node.wxyz = tuple(T_scene_cam.t), tuple(T_scene_cam.wxyz)
        else:
            self._nodes[name] = self._api.add_camera_frustum(
                name,
                fov=2 * float(np.arctan(camera.height / 2 / camera.fy)),
                aspect=camera.width / camera.height,
                scale=_FRUSTUM_DEPTH,
                color=PHOTO_BLUE,
                thickness=1.5,
                thickness_units="screen",
                image=_image(keyframe.thumbnail),
                jpeg_quality=80,
                wxyz=tuple(T_scene_cam.wxyz),
                position=tuple(T_scene_cam.t),
                cast_shadow=False,
                receive_shadow=False,
            )
        return name

    def _unchanged(self, name: str, state: object) -> bool:
        """Whether a node was already sent in this state; notes the state."""
        if self._sent.get(name) == state:
            return True
        self._sent[name] = state
        return False


def _image(jpeg: bytes) -> U8 | None:
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR) if jpeg else None
    return None if image is None else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def _frustum(kept: HeldKeyframe) -> F64:
    """Edges (8, 2, 3) m in world of the pyramid of a photo."""
    camera = kept.keyframe.camera
    corners = np.array([[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]]) - 0.5
    rays = (corners - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    p_cam = np.vstack([np.zeros(3), np.column_stack([rays, np.ones(4)]) * _FRUSTUM_DEPTH])
    p_world = kept.keyframe.T_world_cam.apply(p_cam)
    return np.array([[p_world[a], p_world[b]] for a, b in _FRUSTUM_EDGES])


def _multirotor() -> tuple[F64, U8]:
    """Segments (S, 2, 3) m in body (forward, left, up) of a quadrotor 3 m wide, and their colours (S, 2, 3)."""
    arms = np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]]) * 1.1
    angle = np.linspace(0, 2 * np.pi, 17)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(17)], axis=1) * 0.55 + [0, 0, 0.12]
    rotors = [np.stack([arm + ring[:-1], arm + ring[1:]], axis=1) for arm in arms]
    nose = np.array([[[0.0, 0, 0], [1.9, 0, 0]], [[1.9, 0, 0], [1.5, 0.2, 0]], [[1.9, 0, 0], [1.5, -0.2, 0]]])
    beams = np.stack([np.zeros((4, 3)), arms], axis=1)
    dark = np.concatenate([beams, *rotors])
    colours = np.concatenate([np.full((len(dark), 2, 3), (248, 249, 250)), np.full((len(nose), 2, 3), ACCENT)])
    return np.concatenate([dark, nose]), colours.astype(np.uint8)
