"""The odometry over a kept flight: what it tells at frames at that time, and how far that is from the truth."""

import time
from dataclasses import dataclass, replace

import numpy as np

from air.odometry.estimator import Estimate
from air.odometry.odometry import Odometry
from air.odometry.settings import OdometrySettings
from air.odometry.smoothing import Smoother
from air.odometry.tracker import TrackedFrame
from common.geo import T_world_other
from common.measurements import BASE, GnssEpoch, ImuSample
from common.se3 import rotation_vector
from ground.evaluation.similarity import umeyama

SETTLED_S = 30.0
"""After a disturbance."""
RETURN_S = 10.0
SPEED = 1.0
"""m/s, horizontally: from here on it moves."""


@dataclass(frozen=True, eq=False)
class Run:
    """Poses since the world was found, in the truth's world, each as it was told at its time.

    `t_s` (N,), `error` (N, 3) m east, north, up, `p` (N, 3) m the true positions, `turn_deg` (N, 3) the error of the
    attitude about the same axes, `nees` (N,) of the position, `modes` (N,). `smoothed_error` (N, 3) m is that of the
    path as it was known afterwards. `frame_s` is the CPU time of each frame
    from image to pose, `cpu_s` of everything, over `seconds` of flight. `moving_s` is when it begins to move.
    """

    t_s: np.ndarray
    p: np.ndarray
    error: np.ndarray
    smoothed_error: np.ndarray
    turn_deg: np.ndarray
    nees: np.ndarray
    modes: list
    frame_s: np.ndarray
    cpu_s: float
    seconds: float
    moving_s: float

    def left(self, smoothed=False):
        """Distances (N,) m that remain after a rigid alignment."""
        ours = self.p + (self.smoothed_error if smoothed else self.error)
        return np.linalg.norm(umeyama(ours, self.p, with_scale=False).apply(ours) - self.p, axis=1)

    def between(self, begin_s, end_s):
        """Indices (K,) of the poses of a stretch."""
        return np.flatnonzero((self.t_s >= begin_s) & (self.t_s < end_s))

    @property
    def mode_changes(self):
        """How often the mode changed."""
        return sum(a is not b for a, b in zip(self.modes, self.modes[1:], strict=False))


def run(flight, carrier=True, base=False):
    """The odometry over a flight."""
    settings = OdometrySettings()
    gnss = replace(settings.gnss, selection=replace(settings.gnss.selection, carrier=carrier))
    gnss = replace(gnss, p_body_antenna=tuple(flight.p_body_antenna.tolist()))
    settings = replace(settings, gnss=gnss)
    odometry = Odometry(flight.calibration, "flight", settings, flight.p_base if base else None)
    estimator, waiting, told, frame_s = odometry.estimator, [], [], []
    smoother = estimator.history = Smoother(estimator.buffer)
    begun = time.process_time()
    for message in flight.messages:
        if isinstance(message, GnssEpoch) and message.receiver == BASE and not base:
            continue
        found = []
        if isinstance(message, TrackedFrame):
            waiting.append(message)
        elif isinstance(message, ImuSample):
            estimator.add_imu(message)
            while waiting and waiting[0].t_ns <= message.t_ns:
                frame, since = waiting.pop(0), time.process_time()
                found.append(estimator.add_frame(frame))
                frame_s.append(time.process_time() - since + flight.tracker_s[frame.t_ns])
            found += estimator.take_epochs()
        else:
            odometry.feed(message)
        if (datum := estimator.gnss.datum) is not None:
            told += [(estimate, datum) for estimate in found if isinstance(estimate, Estimate)]
    tracker_s = sum(flight.tracker_s[m.t_ns] for m in flight.messages if isinstance(m, TrackedFrame))
    spent_s = time.process_time() - begun + tracker_s
    if estimator.window is not None:
        smoother.ended(estimator.window)
    path = {state.t_ns: state.T_world_body for state in smoother.states()}
    return _against_the_truth(flight, told, path, np.array(frame_s), spent_s)


def _against_the_truth(flight, told, path, frame_s, cpu_s):
    samples_s = [flight.seconds(m.t_ns) for m in flight.messages if isinstance(m, ImuSample)]
    t_s = np.array([flight.seconds(estimate.state.t_ns) for estimate, _ in told])
    truth = flight.trajectory.at(t_s)
    error, smoothed_error, turn_deg, nees = [], [], [], []
    path_ns = np.array(sorted(path))
    for i, (estimate, datum) in enumerate(told):
        T = T_world_other(flight.datum, datum) @ estimate.state.T_world_body
        error.append(T.t - truth.p_world[i])
        afterwards = path[path_ns[np.argmin(np.abs(path_ns - estimate.state.t_ns))]]
        smoothed_error.append(T_world_other(flight.datum, datum).apply(afterwards.t) - truth.p_world[i])
        in_body = T.R.T @ error[-1]
        nees.append(in_body @ np.linalg.solve(estimate.covariance[3:, 3:], in_body))
        turn_deg.append(np.degrees(rotation_vector(T.R @ truth.R_world_body[i].T)))
    return Run(
        t_s,
        truth.p_world,
        np.array(error).reshape(-1, 3),
        np.array(smoothed_error).reshape(-1, 3),
        np.array(turn_deg).reshape(-1, 3),
        np.array(nees),
        [estimate.mode for estimate, _ in told],
        frame_s,
        cpu_s,
        samples_s[-1] - samples_s[0],
        _moving_s(flight, samples_s[0]),
    )


def _moving_s(flight, first_s):
    """When it moves across the ground, from the first sample on."""
    t_s = np.arange(first_s, flight.trajectory.duration_s, 0.1)
    speeds = np.linalg.norm(flight.trajectory.at(t_s).v_world[:, :2], axis=1)
    return float(t_s[np.argmax(speeds > SPEED)])


def accuracy(run):
    """RMSE, mean and maximum m after alignment, RMSE m of the smoothed path, RMSE m without alignment, roll and pitch,
    yaw °, NEES / 3, s until the world was found, yaw ° then, CPU s for a second, CPU ms of a frame (median, 99 %),
    changes of mode."""
    if not len(run.t_s):
        return [np.nan] * 14
    left = run.left()
    return [
        rms(left),
        left.mean(),
        left.max(),
        rms(run.left(smoothed=True)),
        rms(np.linalg.norm(run.error, axis=1)),
        rms(run.turn_deg[:, :2]),
        rms(run.turn_deg[:, 2]),
        run.nees.mean() / 3,
        run.t_s[0] - run.moving_s,
        abs(run.turn_deg[0, 2]),
        run.cpu_s / run.seconds,
        1e3 * np.median(run.frame_s),
        1e3 * np.quantile(run.frame_s, 0.99),
        run.mode_changes,
    ]


def bridged(run, begin_s, end_s):
    """Of a time without GNSS: m flown, what the error has grown by at its end, as a share of that, and the largest
    step m of the error between two poses after GNSS is back."""
    away, back = run.between(begin_s, end_s), run.between(end_s, end_s + RETURN_S)
    if not len(away) or not len(back):
        return [np.nan] * 3
    flown = np.linalg.norm(np.diff(run.p[away], axis=0), axis=1).sum()
    grown = np.linalg.norm(run.error[away[-1]] - run.error[away[0]])
    steps = np.linalg.norm(np.diff(run.error[[away[-1], *back]], axis=0), axis=1)
    return [flown, grown / flown, steps.max()]


def compared(run, undisturbed, over_s, same_world):
    """RMSE m from 30 s after a disturbance on, the same of the undisturbed flight, and their ratio.

    In the same world both are aligned as the undisturbed stretch is; a world found anew is aligned by itself.
    """
    stretches = [r.between(over_s + SETTLED_S, np.inf) for r in (run, undisturbed)]
    if min(map(len, stretches)) < 3:
        return [np.nan] * 3
    (ours, truth), (theirs, their_truth) = (
        ((r.p + r.error)[k], r.p[k]) for r, k in zip((run, undisturbed), stretches, strict=True)
    )
    alignment = umeyama(theirs, their_truth, with_scale=False)
    usual = rms(np.linalg.norm(alignment.apply(theirs) - their_truth, axis=1))
    alignment = alignment if same_world else umeyama(ours, truth, with_scale=False)
    disturbed = rms(np.linalg.norm(alignment.apply(ours) - truth, axis=1))
    return [disturbed, usual, disturbed / usual]


def rms(values):
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))
