"""The errors of the simulator that the benchmarks turn off in turn, as its options."""

GNSS = {
    "orbits and satellite clocks": {"orbit": 0.0, "satellite_clock": 0.0},
    "ionosphere beyond the model": {
        "ionosphere_residual": 0.0,
        "ionosphere_gradient": 0.0,
        "ionosphere_ripples": 0.0,
    },
    "troposphere beyond the model": {"troposphere_residual": 0.0},
    "receiver's clock": {"clock": 0.0, "clock_drift_ppm": 0.0, "inter_system": 0.0},
    "multipath of the code": {"multipath": 0.0},
    "noise of the code": {"code": 0.0},
    "noise of the Doppler": {"doppler": 0.0},
    "noise and multipath of the carrier": {"phase": 0.0, "carrier_multipath": 0.0},
    "slips and half cycles": {"slips": 0.0, "half_cycle": 0},
}
"""Options of the receiver on board."""

SENSED = {
    **{name: "".join(f"&gnss.{key}={value:g}" for key, value in off.items()) for name, off in GNSS.items()},
    "all of GNSS": "&gnss=perfect",
    "where the antenna sits": "&extrinsics.antenna_m=0",
    "all of the IMU": "&imu=perfect",
}
"""What a flight's URL is given; its video stays the same."""

SEEN = {
    "all of the camera and its lens": "&camera=perfect",
    "how far the lens is from its calibration": "&camera.focal_px=0&camera.centre_px=0",
    "where camera and antenna sit": "&extrinsics=perfect",
    "clocks and ways of the messages": "&clock=perfect",
}
"""What is another video, or another time of it."""
