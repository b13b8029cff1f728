"""A jump of the odometry's world, with which the map moves: what was placed in the world of before is elsewhere now."""

from __future__ import annotations

from dataclasses import dataclass, replace

from common.geo import T_world_other, enu_to_geodetic
from common.messages import Datum, Photo
from common.se3 import SE3


@dataclass(frozen=True, eq=False)
class Jump:
    """What was found at p, m in world at the `datum`, is at `T_new_old` p from `revision` of the world on."""

    t_ns: int
    revision: int
    datum: Datum
    T_new_old: SE3

    def at(self, datum: Datum) -> SE3:
        """The same transform in the world at another datum."""
        T = T_world_other(datum, self.datum)
        return T @ self.T_new_old @ T.inverse()

    def moves(self, photo: Photo) -> bool:
        """Whether a photo was placed in the world of just before: what lies between older ones is not known."""
        return photo.revision == self.revision - 1

    def moved(self, photo: Photo) -> Photo:
        """The photo where it is in the new world. Photos that did not stand in the old one stay as they are."""
        if photo.fix is None or not self.moves(photo):
            return photo
        fix = photo.fix
        here = Datum("", fix.latitude_deg, fix.longitude_deg, fix.height)
        T_new_here = self.T_new_old @ T_world_other(self.datum, here)
        latitude_deg, longitude_deg, height = (float(x) for x in enu_to_geodetic(self.datum, T_new_here.t))
        there = Datum("", latitude_deg, longitude_deg, height)
        turn = T_world_other(there, self.datum).R @ T_new_here.R
        R_enu_cam = None if photo.R_enu_cam is None else turn @ photo.R_enu_cam
        fix = replace(fix, latitude_deg=latitude_deg, longitude_deg=longitude_deg, height=height)
        return replace(photo, fix=fix, R_enu_cam=R_enu_cam, revision=self.revision)
