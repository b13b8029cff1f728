"""The store: what it took in is there after kill -9, and a disk that refuses stops nothing."""

import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from synthetic_map import DATUM_HERE, FLIGHT, keyframe, pose, small_tile

from common.errors import StoreError
from common.messages import TileId
from common.wire import encode
from ground.cloud import Cloud, FlightId
from ground.store import Store, read_store
from ground.tracks import Tracks

UAV1 = FlightId("uav1", FLIGHT)
SECOND = 10**9


def fill(store: Store, cloud: Cloud, tracks: Tracks) -> None:
    for x in range(4):
        tile = small_tile(x, -x, revision=x + 1)
        record = cloud.add("uav1", tile, encode(tile))
        assert record is not None
        store.put(record)
    for message in (keyframe(0, 5.0, 6.0), keyframe(1, 7.0, 8.0, revision=2)):
        kept = cloud.add_keyframe("uav1", message, encode(message))
        assert kept is not None
        store.put(kept)
    datum = cloud.add_datum("uav1", DATUM_HERE, encode(DATUM_HERE))
    assert datum is not None
    store.put(datum)
    for i in range(20):
        where = pose(i * SECOND // 20, float(i), 0.0)
        if (kept_pose := tracks.add("uav1", where, encode(where))) is not None:
            store.put(kept_pose)


def test_everything_put_is_loaded_again(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "ground.sqlite"
    store, cloud, tracks = Store(path), Cloud(), Tracks()
    fill(store, cloud, tracks)
    store.close()

    again, tracks_again = Cloud(), Tracks()
    Store(path).load(again, tracks_again)
    before = {tile.id: (tile.revision, tile.known, tile.confident, tile.payload) for tile in cloud.tiles(UAV1)}
    assert before == {t.id: (t.revision, t.known, t.confident, t.payload) for t in again.tiles(UAV1)}
    assert [k.payload for k in again.keyframes(UAV1)] == [k.payload for k in cloud.keyframes(UAV1)]
    assert [d.datum for d in again.datums()] == [DATUM_HERE]
    np.testing.assert_array_equal(tracks_again.positions(UAV1), tracks.positions(UAV1))
    assert len(tracks.positions(UAV1)) == 10  # 20 Hz for a second, decimated to 10 Hz


def test_a_flush_waits_for_half_a_second_to_pass(tmp_path: Path) -> None:
    store, tile = Store(tmp_path / "s.sqlite"), small_tile(0, 0)
    record = Cloud().add("uav1", tile, encode(tile))
    assert record is not None
    store.put(record)
    assert store.flush(10 * SECOND)
    store.put(record)
    assert not store.flush(10 * SECOND + SECOND // 4)
    assert store.flush(10 * SECOND + SECOND // 2)


WRITER = """
import sys, time
from pathlib import Path
from synthetic_map import small_tile
from common.wire import encode
from ground.cloud import Cloud
from ground.store import Store
store, cloud = Store(Path(sys.argv[1])), Cloud()
tiles = [[(t := small_tile(x, 0, 1 + r), encode(t)) for x in range(20)] for r in range(3)]
n = 0
while True:
    for tile, payload in tiles[n % 3]:
        record = Cloud().add("uav1", tile, payload)
        store.put(record)
        time.sleep(0.002)
        if store.flush(time.monotonic_ns()):
            print(n, flush=True)
    n += 1
"""


def test_kill_9_in_the_middle_of_writing_leaves_a_whole_store(tmp_path: Path) -> None:
    path = tmp_path / "ground.sqlite"
    here = Path(__file__).parent
    script = f"import sys; sys.path[:0] = [{str(here)!r}, {str(here.parent)!r}]\n{WRITER}"
    writer = subprocess.Popen([sys.executable, "-c", script, str(path)], stdout=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    for _ in range(3):
        assert writer.stdout.readline()
    time.sleep(0.1)
    writer.send_signal(signal.SIGKILL)
    writer.wait()
    writer.stdout.close()

    cloud, _ = read_store(path)
    tiles = cloud.tiles(UAV1)
    assert len(tiles) == 20
    for held in tiles:
        assert held.decoded().id == held.id
    connection = sqlite3.connect(path)
    assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    connection.close()
    store = Store(path)
    store.load(Cloud(), Tracks())
    store.close()


def test_a_damaged_file_is_named_and_nothing_is_lost(tmp_path: Path) -> None:
    path = tmp_path / "ground.sqlite"
    path.write_bytes(b"this is no database" * 100)
    store, cloud = Store(path), Cloud()
    with pytest.raises(StoreError, match=r"ground\.sqlite"):
        store.load(cloud, Tracks())
    fill(store, cloud, Tracks())
    with pytest.raises(StoreError, match=r"ground\.sqlite"):
        store.flush(100 * SECOND)
    assert not store.flush(101 * SECOND)  # it does not hammer the disk
    path.unlink()
    assert store.flush(106 * SECOND)
    store.close()
    assert len(read_store(path)[0].tiles(UAV1)) == 4


def test_a_full_disk_is_named_and_written_to_when_it_has_room(tmp_path: Path) -> None:
    path = tmp_path / "ground.sqlite"
    store, cloud = Store(path), Cloud()
    store.load(cloud, Tracks())
    assert store._connection is not None
    pages = store._connection.execute("PRAGMA page_count").fetchone()[0]
    store._connection.execute(f"PRAGMA max_page_count = {pages}")
    fill(store, cloud, Tracks())
    with pytest.raises(StoreError, match="full"):
        store.flush(100 * SECOND)
    assert store.flush(106 * SECOND)  # the connection was opened anew, without the limit
    store.close()
    assert len(read_store(path)[0].tiles(UAV1)) == 4


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="file"):
        Store(tmp_path / "file" / "ground.sqlite").load(Cloud(), Tracks())


def test_a_store_of_another_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "ground.sqlite"
    Store(path).load(Cloud(), Tracks())
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA user_version = 99")
    connection.close()
    for read in (lambda: read_store(path), lambda: Store(path).load(Cloud(), Tracks())):
        with pytest.raises(StoreError, match="99"):
            read()


def test_a_store_that_is_being_created_is_empty(tmp_path: Path) -> None:
    path = tmp_path / "ground.sqlite"
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA journal_mode = WAL")
    assert read_store(path)[0].flights() == []
    connection.close()


def test_a_missing_store_is_named(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"nowhere\.sqlite"):
        read_store(tmp_path / "nowhere.sqlite")


def test_one_damaged_message_costs_only_itself(tmp_path: Path) -> None:
    path = tmp_path / "ground.sqlite"
    store, cloud = Store(path), Cloud()
    fill(store, cloud, Tracks())
    store.close()
    connection = sqlite3.connect(path)
    connection.execute("UPDATE keyframe SET payload = X'00' WHERE number = 0")
    connection.commit()
    connection.close()
    again, _ = read_store(path)
    assert [k.keyframe.index for k in again.keyframes(UAV1)] == [1]
    assert again.tile(UAV1, TileId(0, 3, -3)) is not None
