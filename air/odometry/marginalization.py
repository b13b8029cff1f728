"""What leaving variables knew about those that stay, as one linear factor.

Source: G. Sibley, L. Matthies, G. Sukhatme, Sliding window filter with application to planetary landing (2010), section
3: the Schur complement of the leaving block.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam


def marginalize(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, leaving: Sequence[int]
) -> gtsam.NonlinearFactorGraph:
    """Prior on the keys that share a factor with `leaving` ones, after these were eliminated in this order.

    It is linear at `values`. Factors that touch no leaving key stay out of it. Raises RuntimeError (of gtsam) where the
    graph does not determine the leaving keys.
    """
    going, touched = set(leaving), gtsam.NonlinearFactorGraph()
    for i in range(graph.size()):
        if not going.isdisjoint(graph.at(i).keys()):
            touched.add(graph.at(i))
    remaining = touched.linearize(values).eliminatePartialSequential(gtsam.Ordering(list(leaving)))[1]
    prior = gtsam.NonlinearFactorGraph()
    if remaining.keys().size():
        prior.add(gtsam.LinearContainerFactor(gtsam.HessianFactor(remaining), values))
    return prior
