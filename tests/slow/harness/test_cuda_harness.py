"""The harness that runs CUDA kernels on a CPU: its results are right, and it detects what it is built to detect."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator

import numpy as np
import pytest
from building import FORWARD, HARNESS, REVERSE, SHUFFLED, build_on_cpu, load

THREADS, WARP = 256, 32
LAUNCH_FAILURE, BAD_CONFIGURATION, TOO_LARGE = 719, 9, 720
ORDERS = [(FORWARD, 0), (REVERSE, 0), (SHUFFLED, 1), (SHUFFLED, 2)]


@pytest.fixture(scope="module", params=["switch", "ucontext"])
def examples(request: pytest.FixtureRequest) -> ctypes.CDLL:
    """The kernels of examples.cu, on fibers switched by assembler and by the system."""
    flags = ["-DHARNESS_PORTABLE"] if request.param == "ucontext" else []
    return load(build_on_cpu([HARNESS / "examples.cu"], "examples", flags=[*flags, "-O1"]))


@pytest.fixture(autouse=True)
def forward_again(examples: ctypes.CDLL) -> Iterator[None]:
    yield
    examples.harness_order(FORWARD, 0)


def pointer(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def in_every_order(examples: ctypes.CDLL, name: str, *arguments: object, count: int = THREADS) -> list[np.ndarray]:
    """The float32 results of an example whose output comes after the array it reads, if it reads one."""
    results = []
    for order, seed in ORDERS:
        examples.harness_order(order, seed)
        out = np.full(count, -1.0, np.float32)
        given = [pointer(value) if isinstance(value, np.ndarray) else value for value in arguments]
        place = 1 if arguments and isinstance(arguments[0], np.ndarray) else 0
        assert getattr(examples, name)(*given[:place], pointer(out), *given[place:]) == 0, examples.harness_message()
        results.append(out)
    return results


def distinct(results: list[np.ndarray]) -> int:
    return len({result.tobytes() for result in results})


@pytest.mark.parametrize("name", ["example_add_next", "example_add_next_in_warp"])
def test_missing_barrier_gives_other_results_in_other_orders(examples, name):
    values = np.random.default_rng(1).normal(size=THREADS).astype(np.float32)
    blocks = 1 if name == "example_add_next" else THREADS // WARP
    expected = values + np.roll(values.reshape(blocks, -1), -1, axis=1).ravel()
    for result in in_every_order(examples, name, values, 1):
        np.testing.assert_array_equal(result, expected)
    raced = in_every_order(examples, name, values, 0)
    assert distinct(raced) > 1
    assert all(np.isnan(result).any() for result in raced)  # poison was read


def test_missing_barrier_before_memory_is_used_again_is_found(examples):
    others = (np.arange(THREADS) + THREADS // 2) % THREADS
    for result in in_every_order(examples, "example_reuse", 1):
        np.testing.assert_array_equal(result, 3000.0 + 2.0 * others)
    raced = in_every_order(examples, "example_reuse", 0)
    assert any((result != 3000.0 + 2.0 * others).any() for result in raced)
    assert distinct(raced) > 1


def test_blocks_that_wait_for_each_other_give_other_results_in_other_orders(examples):
    assert distinct(in_every_order(examples, "example_read_neighbour", 40, count=40)) > 1


def rounds_of(blocks: int) -> np.ndarray:
    """What ``example_add_next_block`` gives if blocks wait for each other."""
    held = np.arange(blocks, dtype=np.float32)
    for number in range(3):
        held += np.roll(held + number, -1)
    return held


@pytest.mark.parametrize("blocks", [1, 2, 6])
def test_blocks_of_a_cooperative_launch_wait_for_each_other(examples, blocks):
    for result in in_every_order(examples, "example_add_next_block", blocks, 1, count=blocks):
        np.testing.assert_array_equal(result, rounds_of(blocks))


def test_missing_barrier_of_the_grid_is_found(examples):
    raced = in_every_order(examples, "example_add_next_block", 6, 0, count=6)
    assert all((result != rounds_of(6)).any() for result in raced)
    assert distinct(raced) > 1


@pytest.mark.parametrize(
    ("which", "says"),
    [
        (0, "1 of 3 blocks have returned, and the others wait for the grid at examples.cu:"),
        (1, "different barriers of the grid"),
        (2, "only 255 of 256 threads reached sync_grid"),
    ],
)
def test_blocks_that_do_not_meet_are_reported(examples, which, says):
    for order, seed in ORDERS:
        examples.harness_order(order, seed)
        assert examples.example_miss_grid(which, 1) == LAUNCH_FAILURE
        assert says in examples.harness_message().decode()
        assert example_ok(examples, "example_miss_grid", 3, 1)  # the next launch is not affected


def test_grids_barrier_needs_a_cooperative_launch_that_fits_the_device(examples):
    assert examples.example_miss_grid(3, 0) == LAUNCH_FAILURE
    assert b"in a launch that is not cooperative" in examples.harness_message()
    most = examples.example_together()
    sums = np.zeros(most + 1, np.float32)
    assert example_ok(examples, "example_add_next_block", pointer(sums), most, 1)
    assert examples.example_add_next_block(pointer(sums), most + 1, 1) == TOO_LARGE


def test_order_of_threads_is_as_requested(examples):
    taken = []
    for order, seed in ORDERS:
        examples.harness_order(order, seed)
        counter, out = np.zeros(1, np.int32), np.full(THREADS, -1, np.int32)
        assert example_ok(examples, "example_take_numbers", pointer(counter), pointer(out))
        assert counter[0] == THREADS and sorted(out) == list(range(THREADS))
        taken.append(out)
    np.testing.assert_array_equal(taken[0], np.arange(THREADS))
    np.testing.assert_array_equal(taken[1], np.arange(THREADS)[::-1])
    assert distinct(taken) == len(ORDERS)


def example_ok(examples: ctypes.CDLL, name: str, *arguments: object) -> bool:
    code = getattr(examples, name)(*arguments)
    assert code == 0, examples.harness_message()
    return True


def test_shared_memory_is_poisoned_before_every_block(examples):
    for result in in_every_order(examples, "example_read_unwritten", 3, count=3 * THREADS):
        assert np.isnan(result).all()
        assert (result.view(np.uint32) == 0x7FA5A5A5).all()


@pytest.mark.parametrize(
    ("which", "says"),
    [
        (0, "names threads that have returned"),
        (1, "deadlock"),
        (2, "only 224 of 256 threads reached __syncthreads"),
        (3, "different barriers"),
        (4, "meet in different places"),
        (6, "does not name the thread itself"),
    ],
)
def test_threads_that_do_not_meet_are_reported(examples, which, says):
    for order, seed in ORDERS:
        examples.harness_order(order, seed)
        out = np.zeros(THREADS, np.int32)
        code, message = examples.example_miss(pointer(out), which), examples.harness_message().decode()
        assert code == LAUNCH_FAILURE
        assert message.startswith("miss: ")
        assert says in message and "block" in message and "examples.cu:" in message
        # The next launch is not affected.
        assert example_ok(examples, "example_miss", pointer(out), 5)
        np.testing.assert_array_equal(out[WARP:], np.arange(WARP, THREADS) % WARP ^ 1)


def test_write_beside_shared_memory_is_reported(examples):
    for index in (-1, THREADS, THREADS + 9):
        assert examples.example_write_beside(index) == LAUNCH_FAILURE
        assert b"beside its shared memory 'shared'" in examples.harness_message()
    assert example_ok(examples, "example_write_beside", THREADS - 1)


def test_launch_that_cuda_refuses_is_refused(examples):
    out = np.zeros(1, np.float32)
    assert examples.example_read_unwritten(pointer(out), 0) == BAD_CONFIGURATION
    assert examples.example_ask_for_much() == LAUNCH_FAILURE
    assert b"50000 bytes of shared memory" in examples.harness_message()


def test_operations_of_warps_and_blocks_give_what_cuda_defines(examples):
    rng = np.random.default_rng(3)
    values = rng.integers(0, 31, THREADS).astype(np.int32)
    values[WARP : 2 * WARP] = np.arange(WARP)
    values[2 * WARP : 3 * WARP] = 3
    expected = np.array([operations_of_warp(values, warp) for warp in range(THREADS // WARP)])  # (warps, rows, lanes)
    expected = expected.transpose(1, 0, 2).reshape(-1, THREADS).astype(np.uint32)
    for order, seed in ORDERS:
        examples.harness_order(order, seed)
        out = np.full((len(expected), THREADS), -1, np.int32)
        assert example_ok(examples, "example_all_operations", pointer(values), pointer(out))
        np.testing.assert_array_equal(out.view(np.uint32), expected)


def operations_of_warp(values: np.ndarray, warp: int) -> list[list[int]]:
    """Return the results by the definitions in CUDA's programming guide, lane by lane."""
    v = [int(x) for x in values[warp * WARP : (warp + 1) * WARP]]
    lanes = range(WARP)
    every = [int(x) for x in values]
    return [
        [v[v[i] % WARP] for i in lanes],
        [v[i // 8 * 8 + (i + 3) % 8] for i in lanes],
        [v[i - 3] if i >= 3 else v[i] for i in lanes],
        [v[i + 5] if i % 16 + 5 < 16 else v[i] for i in lanes],
        [v[i ^ 21] for i in lanes],
        [sum((x & 1) << i for i, x in enumerate(v))] * WARP,
        [int(3 in v)] * WARP,
        [int(max(v) < 30)] * WARP,
        [sum((x % 4 == v[i] % 4) << j for j, x in enumerate(v)) for i in lanes],
        [sum(x % 3 != 0 for x in every)] * WARP,
        [int(31 in every)] * WARP,
        [int(max(every) < 31)] * WARP,
        [x.bit_count() + 100 * ((x & -x).bit_length()) + 10000 * (32 - x.bit_length()) for x in v],
        [int(f"{x:032b}"[::-1], 2) for x in v],
        [v[31 - i] for i in lanes],
        [v[31 - i] for i in lanes],
    ]
