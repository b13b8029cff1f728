"""Ambiguities of differences to a base station as whole cycles: a place good to decimetres becomes good to centimetres.

Differences between two satellites of one system are free of both receivers' delays, so they are integers. Source:
Teunissen, Montenbruck (editors), Springer Handbook of GNSS (2017), chapter 23.
"""

from __future__ import annotations

from itertools import groupby

import numpy as np

from air.gnss.integers import find_integers
from air.gnss.signals import LIGHT, PRIMARY, frequency
from air.odometry.gnss_bands import DIFFERENTIAL
from air.odometry.gnss_biases import BiasNode, Kind
from air.odometry.quadratic import Quadratic
from common.arrays import F64

CODE_DIVISION = "GECJ"
"""Systems whose satellites share a frequency."""
LEAST, SHARE = 8, 0.6
"""Fewer differences, and a smaller share of them, are fixed by chance."""
SIGMA_FIXED = 0.01
"""Of a difference that has been fixed, m."""


def fix(node: BiasNode, u: F64, covariance: F64) -> Quadratic | str:
    """What whole cycles say about the biases (D,) of a node that are known with a covariance (D, D), or why nothing."""
    D, wavelength = _differences(node, np.diag(covariance))
    if not len(D):
        return "no two carriers of one system"
    scaled = D / wavelength[:, None]
    # How far the best integers are says little: multipath of carriers makes the real values surer than they are.
    found = find_integers(scaled @ u, scaled @ covariance @ scaled.T, least=max(LEAST, round(SHARE * len(D))))
    if isinstance(found, str):
        return found
    rows, left = D[found.fixed], (found.integers * wavelength)[found.fixed] - D[found.fixed] @ u
    weight = SIGMA_FIXED**-2.0
    return Quadratic({node.key: u}, weight * rows.T @ rows, weight * rows.T @ left, float(weight * left @ left))


def _differences(node: BiasNode, variance: F64) -> tuple[F64, F64]:
    """Rows (N, D) that take each ambiguity minus its system's best known one, and their wavelengths (N,) m."""
    columns = [
        (name[0], column)
        for (kind, name), column in node.biases.items()
        if kind is Kind.AMBIGUITY and name[0] in CODE_DIVISION and DIFFERENTIAL in name
    ]
    rows, wavelengths = [], []
    for system, group in groupby(sorted(columns), key=lambda one: one[0]):
        members = sorted((column for _, column in group), key=lambda column: variance[column])
        for column in members[1:]:
            row = np.zeros(len(node))
            row[column], row[members[0]] = 1.0, -1.0
            rows.append(row)
            wavelengths.append(LIGHT / frequency(system, PRIMARY[system], 0))
    return np.array(rows).reshape(-1, len(node)), np.array(wavelengths)
