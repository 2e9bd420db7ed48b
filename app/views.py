"""Where each viewer looks from. The page frames what there is to see by itself, until a viewer takes the camera."""

from __future__ import annotations

import asyncio
import threading
from dataclasses import dataclass, replace

import numpy as np
import viser
from numpy.typing import NDArray

from .geometry import behind, distance_to_path, overview, seen_from, square_side, sticks_out
from .grids import WallGrids
from .scene import Scene

Array = NDArray[np.float64]

FOV_RAD = np.radians(50.0)
STRAIGHT_FOV_RAD = np.radians(8.0)  # seen from far away, what is parallel stays so
LEAN = 0.002  # off the plumb line, where a camera would not know how to turn
GLIDE_S, GLIDE_STEPS_PER_S = 0.6, 30
GLIDERS = 4  # with more viewers each one's camera jumps: thirty messages a second to each would cost the engine
MOVED, A_LITTLE, WORTH_A_MOVE = 0.02, 0.01, 0.12  # of the distance to what one looks at
REMEMBERED, REMEMBERED_BEHIND = 8, 40


@dataclass(frozen=True)
class _Framing:
    """Where the page has put a viewer's camera. way: [k, 3] the places on the way there, the last one ``position``;
    follows: it goes behind the run's camera, else it has everything in sight."""

    position: Array
    look_at: Array
    way: Array
    follows: bool = False

    def left(self, client: viser.ClientHandle) -> bool:
        """Whether the viewer has taken the camera off the way; however late a browser reports, it reports places on
        it."""
        distance = np.linalg.norm(self.position - self.look_at)
        return distance_to_path(np.array(client.camera.position), self.way) > MOVED * distance


class Views:
    """Moves viewers' cameras. Only the hub's thread calls these methods."""

    def __init__(self, server: viser.ViserServer, scene: Scene) -> None:
        self._server, self._scene, self.walls = server, scene, WallGrids(server)
        self._framed: dict[int, _Framing] = {}
        self._flights: dict[int, object] = {}
        self._placing = threading.Lock()
        self._points = scene.points
        self._places: dict[float, tuple[Array, Array]] = {}

    def welcome(self, client: viser.ClientHandle) -> None:
        """Give a new viewer a first view."""
        if client.client_id in self._server.get_clients():
            client.camera.fov = FOV_RAD
            self.show_all(client, 0.0)

    def begin(self) -> None:
        """A new run: bring it into everybody's sight; who follows goes on with that when its camera is known."""
        for client in self._server.get_clients().values():
            framing = self._framed.get(client.client_id)
            self.show_all(client, 0.0)
            if framing is not None and framing.follows:
                self._framed[client.client_id] = replace(self._framed[client.client_id], follows=True)

    def show_all(self, client: viser.ClientHandle, seconds: float = GLIDE_S) -> None:
        """Bring everything into one viewer's sight, and keep it there as the map grows."""
        self.walls.take_down(client)
        place = self._all(client)
        self._framed[client.client_id] = _Framing(*place, self._way(client, place[0], REMEMBERED))
        self._fly(client, *place, seconds)

    def keep_framed(self) -> None:
        """The map has grown: move along the viewers that have left their camera to the page."""
        clients = self._server.get_clients()
        self._framed = {k: framing for k, framing in self._framed.items() if k in clients}
        self._flights = {k: flight for k, flight in self._flights.items() if k in clients}
        for number, framing in list(self._framed.items()):
            client, distance = clients[number], np.linalg.norm(framing.position - framing.look_at)
            if framing.left(client):
                del self._framed[number]
            if framing.left(client) or framing.follows:
                continue
            position, look_at = self._all(client)
            away = max(np.linalg.norm(position - framing.position), np.linalg.norm(look_at - framing.look_at))
            if away > (A_LITTLE if self._outgrown(client, framing) else WORTH_A_MOVE) * distance:
                self.show_all(client, 2 * GLIDE_S if len(clients) <= GLIDERS else 0.0)

    def reshaped(self, client: viser.ClientHandle) -> None:
        """A viewer's window has another shape: frame everything anew where the camera has been left to the page."""
        framing = self._framed.get(client.client_id)
        if framing is not None and not framing.follows and not framing.left(client):
            self.show_all(client, 0.0)

    def show(self, client: viser.ClientHandle, points: Array) -> None:
        """Bring points [n, 3] into one viewer's sight."""
        self._leave(client)
        self._fly(client, *self._overview(points, client.camera.aspect), GLIDE_S)

    def straight(self, client: viser.ClientHandle, above: bool) -> None:
        """Show one viewer everything as a drawing does: from above, or from the side, square to the nearest walls and
        before a grid."""
        scene, mesh = self._scene, self._scene.mesh
        if mesh is None:
            self.show_all(client)
            return
        towards = np.array(client.camera.position) - np.array(client.camera.look_at)
        plumb = np.linalg.norm(np.cross(scene.up, towards)) == 0
        side = square_side(mesh, scene.up, scene.side if plumb else towards)
        self._leave(client)
        back = scene.up + LEAN * side if above else side
        place = seen_from(scene.points, scene.up, back, client.camera.aspect or 1.5, STRAIGHT_FOV_RAD)
        if not above:
            depth = -float(((mesh.vertices - scene.floor) @ side).min())
            self.walls.put_up(client, scene.floor, scene.up, side, depth)
        self._fly(client, *place, GLIDE_S, STRAIGHT_FOV_RAD)

    def visit(self, client: viser.ClientHandle, c2w: Array) -> None:
        """Fly one viewer to just behind a keyframe."""
        self._leave(client)
        self._fly(client, *behind(c2w, self._scene.up, 0.45), GLIDE_S)

    def follow(self, client: viser.ClientHandle, c2w: Array) -> None:
        """Put one viewer just behind the run's camera, and keep it there until the viewer moves or goes elsewhere."""
        self.walls.take_down(client)
        place = behind(c2w, self._scene.up)
        way = self._way(client, place[0], REMEMBERED_BEHIND)
        self._framed[client.client_id] = _Framing(*place, way, follows=True)
        self._place(client, self._depart(client), *place)

    def move_along(self, c2w: Array) -> None:
        """The run's camera has moved: so do the viewers that follow it."""
        for client in self._server.get_clients().values():
            framing = self._framed.get(client.client_id)
            if framing is not None and framing.follows and not framing.left(client):
                self.follow(client, c2w)

    def _outgrown(self, client: viser.ClientHandle, framing: _Framing) -> bool:
        place, aspect = (framing.position, framing.look_at), client.camera.aspect or 1.5
        return sticks_out(self._scene.points, self._scene.up, *place, aspect, FOV_RAD)

    def _way(self, client: viser.ClientHandle, position: Array, most: int) -> Array:
        """The last places [k, 3] that the page has put a viewer at, then where it is and where it goes."""
        framing = self._framed.get(client.client_id)
        before = [] if framing is None or framing.left(client) else list(framing.way)
        return np.stack([*before, np.array(client.camera.position), position])[-most:]

    def _leave(self, client: viser.ClientHandle) -> None:
        self.walls.take_down(client)
        self._framed.pop(client.client_id, None)

    def _all(self, client: viser.ClientHandle) -> tuple[Array, Array]:
        """The overview of everything; worked out once for all viewers whose windows have the same shape."""
        if self._points is not self._scene.points:
            self._points, self._places = self._scene.points, {}
        aspect = client.camera.aspect
        if aspect not in self._places:
            self._places[aspect] = self._overview(self._points, aspect)
        return self._places[aspect]

    def _overview(self, points: Array, aspect: float) -> tuple[Array, Array]:
        return overview(points, self._scene.up, self._scene.side, aspect or 1.5, FOV_RAD)

    def _fly(
        self, client: viser.ClientHandle, position: Array, look_at: Array, seconds: float, fov: float = FOV_RAD
    ) -> None:
        start = np.array(client.camera.position), np.array(client.camera.look_at), client.camera.fov
        flight = self._depart(client)

        async def glide() -> None:
            steps = max(1, int(GLIDE_STEPS_PER_S * seconds))
            for step in range(1, steps + 1):
                if client.client_id not in self._server.get_clients():
                    return
                t = step / steps
                ease = t * t * (3 - 2 * t)
                self._place(
                    client,
                    flight,
                    start[0] + ease * (position - start[0]),
                    start[1] + ease * (look_at - start[1]),
                    start[2] + ease * (fov - start[2]),
                )
                await asyncio.sleep(1 / GLIDE_STEPS_PER_S)

        asyncio.run_coroutine_threadsafe(glide(), self._server.get_event_loop())

    def _depart(self, client: viser.ClientHandle) -> object:
        """Begin a flight; it ends the one that the viewer is on."""
        with self._placing:
            self._flights[client.client_id] = flight = object()
        return flight

    def _place(
        self, client: viser.ClientHandle, flight: object, position: Array, look_at: Array, fov: float = FOV_RAD
    ) -> None:
        with self._placing, client.atomic():
            if self._flights.get(client.client_id) is flight:
                client.camera.up_direction = self._scene.up
                client.camera.fov = fov
                client.camera.position = position
                client.camera.look_at = look_at
