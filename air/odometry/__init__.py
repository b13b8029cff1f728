"""Tightly coupled GNSS–visual–inertial odometry: frames, IMU samples and raw GNSS in, poses and keyframes out."""
