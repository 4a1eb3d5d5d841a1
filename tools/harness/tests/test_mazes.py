"""TableMaze: whose mazes, where the peg begins, and that walls hold it back."""

from typing import Any

import numpy as np
import pytest

from actrm_harness.simulators.robosuite import envs, suite

suite.prepare()


@pytest.mark.parametrize(("task", "side"), [("TableMaze", 8), ("TableMaze10", 10)])
def test_a_maze_is_what_its_split_holds_and_walls_hold(task: str, side: int) -> None:
    session = envs.make(task)
    env: Any = session.env
    drawn: dict[bool, set[str]] = {True: set(), False: set()}
    for demonstration in (True, False):
        for seed in range(25):
            seen = envs.reset(session, seed, demonstration)
            text: str = env.get_ep_meta()["maze"]
            drawn[demonstration].add(text.split(maxsplit=1)[0])
            walls = seen["maze_walls"].reshape(10, 10)
            rim = (10 - side) // 2
            inner = walls[rim : 10 - rim, rim : 10 - rim]
            assert "".join(str(int(wall)) for wall in inner.ravel()) == text.split(maxsplit=1)[0]
            assert walls.sum() - inner.sum() == 100 - side * side
            assert int(np.argmax(seen["peg_cell"])) == env.start and envs.failure(env) is None
            assert np.abs(seen["peg_pos"][:2] - env.center(env.start)[:2]).max() < 1e-6
    assert not drawn[True] & drawn[False] and min(len(each) for each in drawn.values()) > 5
    # pushed against the walls for a second in every direction, the peg comes through none: it stops, or is lifted out
    reached: set[int] = set()
    for direction in np.vstack([np.eye(2), -np.eye(2)]):
        envs.reset(session, 3)
        action = np.concatenate([direction, [0.0, 0.0, 0.0, 0.0, -1.0]])
        for _ in range(20):
            result = envs.step(env, action, None)
            assert result.failure in (None, "lifted"), direction
            if result.failure is not None:
                break
            reached.add(env.cell_of(env.tip()))
    assert all(not env.walls[cell] for cell in reached)
    # over the walls is not through the maze
    envs.reset(session, 3)
    lifts = [envs.step(env, np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0]), None).failure for _ in range(12)]
    assert lifts[-1] == "lifted"
    env.close()
