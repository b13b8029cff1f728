"""Bundle adjustment: poses, points and intrinsics that explain all observations best (gtsam, Levenberg–Marquardt).

Observations are reprojection errors with a robust kernel; positions of the receiver and attitudes of the gimbal are
priors of their own accuracy; the intrinsics have one weak prior each camera (self-calibration of the focal length,
the principal point and two radial terms).

Image lengths are in units of the image's width inside the graph: in pixels the optimizer's damping would weigh most on
the focal length, which the images of a flat site hardly determine, and stop it half-way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import K, L, X

from common.arrays import F64, I64, Bool
from common.camera import CameraModel
from common.se3 import SE3

noise = gtsam.noiseModel
UNTIED = 1e-6
"""fx and fy are one focal length: their difference may not exceed about this, widths."""
FIXED, UNKNOWN = 1e-7, 1e6
POINT_SIGMA = 1000.0
"""Weak prior of a point, m: keeps the system regular when a step takes a point behind its cameras."""
HUBER = 1.345
LM_ITERATIONS, LM_TOLERANCE = 8, 1e-3
GN_ITERATIONS, GN_TOLERANCE = 10, 1e-5
DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True, eq=False)
class CameraPrior:
    """A camera's first guess and how far its focal length, principal point (widths) and radial terms may be off."""

    guess: CameraModel
    focal_sigma: float
    principal_sigma: float
    radial_sigma: float


@dataclass(frozen=True, eq=False)
class PosePrior:
    """What is known of a camera's pose without images.

    Position (3,) m with sigma (3,), or None; the unit vector (3,) that points down, in the camera frame, with sigma
    rad. The heading is left open: gimbals get it wrong, and steps between positions tell it better.
    """

    p_world: F64 | None
    p_sigma: F64
    down_cam: F64
    down_sigma: float


@dataclass(frozen=True, eq=False)
class BundleProblem:
    """N photos, P points, M observations.

    `camera_of` (N,) indexes `cameras`; `fixed` (N,) marks poses that stay; `photo` and `point` (M,) say who saw what
    at `uv` (M, 2) px with `pixel_sigma`; intrinsics move only if `calibrate`. With `final` the observations are
    taken to be free of outliers and count by their squares, and the sigmas of the positions are computed.
    """

    cameras: Sequence[CameraModel]
    camera_priors: Sequence[CameraPrior]
    camera_of: Sequence[int]
    poses: Sequence[SE3]
    pose_priors: Sequence[PosePrior]
    fixed: Bool
    points: F64
    photo: I64
    point: I64
    uv: F64
    pixel_sigma: float
    calibrate: bool
    final: bool


@dataclass(frozen=True, eq=False)
class BundleSolution:
    """Adjusted cameras, poses and points (P, 3); `sigma` (N, 3) m of the positions or None."""

    cameras: list[CameraModel]
    poses: list[SE3]
    points: F64
    sigma: F64 | None
    iterations: int


def adjust(problem: BundleProblem) -> BundleSolution:
    """The adjusted problem. Raises RuntimeError (of gtsam) when the system is singular."""
    graph, values = _observations(problem)
    _add_pose_priors(graph, problem)
    if problem.calibrate:
        _add_camera_priors(graph, problem)
    ordering = _points_first(problem)
    result, iterations = _levenberg_marquardt(graph, values, ordering)
    if problem.calibrate:
        result, more = _gauss_newton(graph, result, ordering)
        iterations += more
    return BundleSolution(
        cameras=_cameras(result, problem),
        poses=[_se3(result.atPose3(X(i))) for i in range(len(problem.poses))],
        points=np.array([result.atPoint3(L(j)) for j in range(len(problem.points))]).reshape(-1, 3),
        sigma=_position_sigma(graph, result, problem) if problem.final else None,
        iterations=iterations,
    )


def _cameras(result: gtsam.Values, problem: BundleProblem) -> list[CameraModel]:
    if not problem.calibrate:
        return list(problem.cameras)
    return [_from_gtsam(result.atCal3DS2(K(i)), camera) for i, camera in enumerate(problem.cameras)]


def _levenberg_marquardt(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, ordering: gtsam.Ordering
) -> tuple[gtsam.Values, int]:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(LM_ITERATIONS)
    parameters.setRelativeErrorTol(LM_TOLERANCE)
    parameters.setOrdering(ordering)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    return optimizer.optimize(), optimizer.iterations()


def _gauss_newton(
    graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, ordering: gtsam.Ordering
) -> tuple[gtsam.Values, int]:
    """The minimum along the curved valley in which focal length and height make up for each other.

    A step along it may first raise the error, so a method that accepts only descent creeps; undamped steps arrive in
    three or four. What does not end below the start is given up.
    """
    values, before = start, graph.error(start)
    best, least = start, before
    for iteration in range(GN_ITERATIONS):
        try:
            values = values.retract(graph.linearize(values).optimize(ordering))
        except RuntimeError:  # a step that went too far left the system singular
            return best, iteration
        error = graph.error(values)
        if error < least:
            best, least = values, error
        if abs(before - error) < GN_TOLERANCE * error:
            return best, iteration + 1
        before = error
    return best, GN_ITERATIONS


def _points_first(problem: BundleProblem) -> gtsam.Ordering:
    """Elimination order of the Schur complement: points, poses, intrinsics."""
    ordering = gtsam.Ordering()
    for j in range(len(problem.points)):
        ordering.push_back(L(j))
    for i in range(len(problem.poses)):
        ordering.push_back(X(i))
    for i in range(len(problem.cameras) if problem.calibrate else 0):
        ordering.push_back(K(i))
    return ordering


def _observations(problem: BundleProblem) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i, T in enumerate(problem.poses):
        values.insert(X(i), gtsam.Pose3(gtsam.Rot3(T.R), T.t))
    known = [_to_gtsam(camera) for camera in problem.cameras]
    if problem.calibrate:
        for i, calibration in enumerate(known):
            values.insert(K(i), calibration)
    anywhere = noise.Isotropic.Sigma(3, POINT_SIGMA)
    for j, p in enumerate(problem.points):
        values.insert(L(j), p)
        graph.add(gtsam.PriorFactorPoint3(L(j), p, anywhere))
    width = np.array([camera.width for camera in problem.cameras])[problem.camera_of]
    model = [noise.Isotropic.Sigma(2, problem.pixel_sigma / camera.width) for camera in problem.cameras]
    if not problem.final:
        model = [_robust(m) for m in model]
    camera_of = problem.camera_of
    uv_widths = problem.uv / width[problem.photo][:, None]
    for i, j, uv in zip(problem.photo.tolist(), problem.point.tolist(), uv_widths, strict=True):
        c = camera_of[i]
        if problem.calibrate:
            graph.add(gtsam.GeneralSFMFactor2Cal3DS2(uv, model[c], X(i), L(j), K(c)))
        else:
            graph.add(gtsam.GenericProjectionFactorCal3DS2(uv, model[c], X(i), L(j), known[c], False, False))
    return graph, values


def _add_pose_priors(graph: gtsam.NonlinearFactorGraph, problem: BundleProblem) -> None:
    for i, (T, prior) in enumerate(zip(problem.poses, problem.pose_priors, strict=True)):
        if problem.fixed[i]:
            stay = noise.Isotropic.Sigma(6, FIXED)
            graph.add(gtsam.PriorFactorPose3(X(i), gtsam.Pose3(gtsam.Rot3(T.R), T.t), stay))
            continue
        if prior.p_world is not None:
            # Height apart from the rest: a receiver's height can be far off while its position is good.
            for axes in ([True, True, False], [False, False, True]):
                sigmas = np.where(axes, prior.p_sigma, UNKNOWN)
                graph.add(gtsam.GPSFactor(X(i), prior.p_world, _robust(noise.Diagonal.Sigmas(sigmas))))
        model = _robust(noise.Isotropic.Sigma(2, prior.down_sigma))
        graph.add(gtsam.AttitudeFactorPose3(X(i), gtsam.Unit3(DOWN), model, gtsam.Unit3(prior.down_cam)))


def _add_camera_priors(graph: gtsam.NonlinearFactorGraph, problem: BundleProblem) -> None:
    for i, prior in enumerate(problem.camera_priors):
        f, c, k = prior.focal_sigma, prior.principal_sigma, prior.radial_sigma
        covariance = np.diag(np.array([f, f, FIXED, c, c, k, k, FIXED, FIXED]) ** 2)
        covariance[0, 1] = covariance[1, 0] = f**2 - UNTIED**2
        graph.add(gtsam.PriorFactorCal3DS2(K(i), _to_gtsam(prior.guess), noise.Gaussian.Covariance(covariance)))


def _position_sigma(graph: gtsam.NonlinearFactorGraph, result: gtsam.Values, problem: BundleProblem) -> F64 | None:
    try:
        marginals = gtsam.Marginals(graph, result)
    except RuntimeError:  # nearly singular: the poses stand, only how good they are remains unsaid
        return None
    sigma = np.zeros((len(problem.poses), 3))
    for i, T in enumerate(problem.poses):
        # gtsam's pose covariance is in the camera frame, rotation first.
        cov_world = T.R @ marginals.marginalCovariance(X(i))[3:, 3:] @ T.R.T
        sigma[i] = np.sqrt(np.diag(cov_world))
    return sigma


def _robust(model: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
    return noise.Robust.Create(noise.mEstimator.Huber.Create(HUBER), model)


def _to_gtsam(c: CameraModel) -> gtsam.Cal3DS2:
    w = c.width
    return gtsam.Cal3DS2(c.fx / w, c.fy / w, 0.0, c.cx / w, c.cy / w, c.k1, c.k2, c.p1, c.p2)


def _from_gtsam(calibration: gtsam.Cal3DS2, like: CameraModel) -> CameraModel:
    v = calibration.vector()
    fx, fy, cx, cy = (float(x) * like.width for x in (v[0], v[1], v[3], v[4]))
    k1, k2, p1, p2 = (float(x) for x in v[5:])
    return replace(like, fx=fx, fy=fy, cx=cx, cy=cy, k1=k1, k2=k2, p1=p1, p2=p2)


def _se3(pose: gtsam.Pose3) -> SE3:
    return SE3(pose.rotation().matrix(), np.asarray(pose.translation(), float))
