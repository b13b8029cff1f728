import sys

import numpy as np
from mapping_scene import BOXES, CAMERA, Scene, block
from numba.core.dispatcher import Dispatcher

from air.mapping.mapper import Mapper
from air.warm_up import warm_up


def compiled():
    """What is compiled of the mapper: module and name of each loop with the types of its arguments."""
    loops = [
        (name, loop)
        for name, module in list(sys.modules.items())
        if name.startswith("air.mapping")
        for loop in vars(module).values()
        if isinstance(loop, Dispatcher)
    ]
    return {(name, loop.py_func.__name__, str(types)) for name, loop in loops for types in loop.signatures}


def test_the_first_photos_of_a_flight_compile_nothing_after_warming_up():
    assert warm_up()
    before = compiled()
    assert before
    scene, mapper, frames = Scene(BOXES), Mapper(), block(1, 2)
    for frame in frames:
        mapper.add_image(frame.index, scene.photo(CAMERA, frame.T_world_cam))
    tiles = mapper.update("flight", frames, 0.0)
    assert any(np.isfinite(tile.height).any() for tile in tiles)
    assert compiled() == before
