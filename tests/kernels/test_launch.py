"""Launches cover every item once and check their arguments; modules load once."""

import contextlib
import dataclasses
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import warp as wp
from torch._subclasses.fake_tensor import FakeTensorMode

from bench.lib.kernel_calls import adam_step
from tests.gaussians import camera, cloud
from tests.kernels.test_guard_bytes import rendering, similarity
from warpgs.errors import ResourceError
from warpgs.kernels import launch, native
from warpgs.kernels.graphs import CapturedGraph, fetch
from warpgs.kernels.neighbours import mean_square_distances
from warpgs.kernels.update import Setting, opacity_dropout
from warpgs.render.rasterize import rasterize
from warpgs.scene import Gaussians

CPU = torch.device("cpu")


@wp.kernel(enable_backward=False)
def mark(
    begin: int,
    # outputs
    visits: wp.array(dtype=int), firsts: wp.array(dtype=int),
):  # fmt: skip
    i = begin + wp.tid()
    visits[i] = visits[i] + 1
    firsts[i] = begin


def marked(count: int = 30_000, **options) -> tuple[torch.Tensor, torch.Tensor]:
    visits, firsts = torch.zeros(2, count, dtype=torch.int32).unbind()
    launch.launch(mark, count, [visits, firsts], CPU, **options)
    return visits, firsts


@pytest.mark.parametrize(
    ("threads", "count", "cost", "ranges"),
    [
        (1, 30_000, 1, 1), (2, 30_000, 9, 16), (4, 30_001, 99, 32), (5, 30_000, 99, 20), (2, 1, 10**6, 1),
        (2, 2, 10_000, 2), (2, 2, 9_999, 1), (2, 5, 40_000, 5), (2, 19_999, 1, 1), (2, 20_000, 1, 2), (2, 0, 1, 0),
        (2, 39_999, 1, 3), (4, 30_001, 1, 4),
    ],
)  # fmt: skip
def test_ranges_cover_every_item_once(monkeypatch, threads, count, cost, ranges):
    """There are as many ranges as there is work for, and at most one hand-over to each other thread; small ones have none."""
    handed = []
    monkeypatch.setattr(launch, "_pool", lambda *_: SimpleNamespace(put=lambda work: handed.append(work())))
    torch.set_num_threads(threads)
    visits, firsts = marked(count, cost=cost)
    assert bool((visits == 1).all())
    assert sorted(set(firsts.tolist())) == [count * i // ranges for i in range(ranges)]
    assert len(handed) == max(min(threads, ranges) - 1, 0)


def everything():
    moved = torch.rand(3 * 4096, 3, generator=torch.Generator().manual_seed(1))
    state = [moved, moved.flip(0).contiguous(), moved * 0, moved * 0]
    adam_step(*state, lr=0.1, step=1)
    settings = Setting.row(dropout=0.3, number=1, step=1, means_lr=0.1, shift=(0.0, 0.0, 0.0))
    factors = opacity_dropout(53, torch.tensor(settings, dtype=torch.float32), 5)
    return [*rendering(CPU, 2), *similarity(CPU, 2), *state, mean_square_distances(moved[:91]), factors]


def test_every_op_gives_the_same_bits_however_its_items_run(monkeypatch):
    """In ranges of unequal length, or one by one from the last: they share nothing, none is left out, all memory is written."""
    torch.set_num_threads(1)
    whole = everything()

    def backwards(kernel, count, inputs, device, **_):
        arrays = [launch.as_array(a, *array) if array else a for a, array in zip(inputs, launch._declared(kernel))]
        for i in reversed(range(count)):
            wp.launch(kernel, 1, inputs=[i, *arrays], device="cpu")

    # Warp counts a negative index from the end: a kernel that went backwards would visit every item of equal ranges
    monkeypatch.setattr(launch, "SERIAL_WORK", 1)
    monkeypatch.setattr(launch, "CHUNKS_PER_THREAD", 2)
    torch.set_num_threads(4)
    torch.use_deterministic_algorithms(True)  # torch fills what it allocates with NaN and with the largest numbers
    try:
        assert bool(torch.empty(3).isnan().all())
        for work in (launch.launch, backwards):
            monkeypatch.setattr(launch, "launch", work)
            for i, (a, b) in enumerate(zip(whole, everything(), strict=True)):
                assert torch.equal(a, b), i
    finally:
        torch.use_deterministic_algorithms(False)


@pytest.mark.parametrize("several", [False, True])
def test_the_device_that_is_current_stays_so(monkeypatch, several):
    """Warp leaves the one current that it worked on: where there are several, launches and its own work stand in a guard."""
    events, device = [], torch.device("cuda", 1)

    @contextlib.contextmanager
    def guard(where):
        events.append(("enter", where))
        yield
        events.append("exit")

    noted = SimpleNamespace(stream="before", launch=lambda *_: events.append("launch"))
    noted.set_stream = lambda stream, sync: events.append(stream)
    monkeypatch.setattr(torch.cuda, "device", guard)
    own = {"_several_devices": several, "_recorded": noted, "warp_stream": "ours", "warp_device": noted}
    for name, value in own.items():
        monkeypatch.setattr(launch, name, lambda *_, value=value: value)
    launch.launch(mark, 1, [None, None], device)
    with launch.stream_of(device):
        events.append("sort")
    guarded = [[("enter", device), *body, "exit"] if several else body for body in (["launch"], ["ours", "sort", "before"])]
    assert events == guarded[0] + guarded[1]


@wp.struct
class Pair:
    count: wp.int32
    step: wp.float64


@wp.kernel(enable_backward=False)
def add_turned(begin: int, pair: Pair, turn: wp.mat33d, shift: wp.vec3d, found: wp.array(dtype=wp.float64)):
    i = begin + wp.tid()
    column = turn * wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
    found[i] = found[i] + wp.float64(pair.count) * pair.step + column[i] + shift[i]


def test_a_recorded_launch_takes_structs_vectors_and_matrices_by_value(device):
    def pair(count, step):
        made = Pair()
        made.count, made.step = count, step
        return made

    first, second = pair(1, 0.5), pair(3, 2.0)
    found, totals = torch.zeros(3, dtype=torch.float64, device=device), []
    for given, scale in ((first, 0.0), (second, 0.0), (second, 1.0), (first, -2.0)):
        turn = wp.mat33d(*[scale * 10.0**k for k in range(9)])
        launch.launch(add_turned, 3, [given, turn, wp.vec3d(0.0, 0.0, scale), found], device)
        totals.append(found.tolist())
    assert totals == [[0.5] * 3, [6.5] * 3, [13.5, 1012.5, 1000013.5], [12.0, -987.0, -999988.0]]
    assert (first.count, first.step, second.count, second.step) == (1, 0.5, 3, 2.0)
    assert first.__ctype__().count == 1 and second.__ctype__().count == 3


def test_a_thread_launches_with_its_own_arguments(monkeypatch):
    """One kernel from two threads at a time, over memory of other sizes, each interrupted between patch and launch."""
    patch, meeting, counts = launch._Recorded._patch, threading.Barrier(2), (1000, 30)

    def launches(count):
        visits, firsts = torch.zeros(2, count, dtype=torch.int32).unbind()
        found = []
        for _ in range(3):
            launch.launch(mark, count, [visits, firsts], torch.device("cpu"))
            found.append(visits.tolist())
        return found

    def interrupted(recorded, *given):
        patch(recorded, *given)
        meeting.wait(10)

    monkeypatch.setattr(launch._Recorded, "_patch", interrupted)

    with ThreadPoolExecutor(2) as pool:
        for count, found in zip(counts, pool.map(launches, counts), strict=True):
            assert found == [[times] * count for times in (1, 2, 3)]


FORKED = """
import os, signal
from tests.gaussians import camera, cloud
from warpgs.kernels import launch
from warpgs.render.rasterize import rasterize
import torch
torch.set_num_threads(2)
g, cam = cloud(2000), camera(75, 53, dtype=torch.float32)
image = rasterize(g, cam).rgb
child = os.fork()
if child == 0:
    signal.alarm(20)
    os._exit(0 if torch.equal(rasterize(g, cam).rgb, image) else 3)
print(launch._pool.cache_info().currsize, os.waitpid(child, 0)[1])
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_process_launches_in_threads_of_its_own():
    """The parent's do not exist there, and nothing may wait for them."""
    found = subprocess.run([sys.executable, "-c", FORKED], check=False, capture_output=True, text=True)
    assert found.stdout.split() == ["1", "0"], found.stderr


def interrupted_at(number: int, call) -> bool:
    """Run ``call`` with a Ctrl-C at the n-th begin of a function or end of a call into C; return whether it came that far."""
    left = number

    def profile(frame, event, _):
        nonlocal left
        left -= event in ("call", "c_return")
        if left == 0:
            sys.setprofile(None)
            raise KeyboardInterrupt

    sys.setprofile(profile)
    try:
        call()
    except KeyboardInterrupt:
        return True
    finally:
        sys.setprofile(None)
    return False


def test_an_interrupt_at_any_time_leaves_no_thread_at_work(monkeypatch):
    """The caller frees the memory that the threads use, and the next launch writes their arguments anew."""
    torch.set_num_threads(2)
    pool, handed = launch._pool.__wrapped__(1, 0), []

    def put(work):
        handed.append(work)
        pool.put(work)

    monkeypatch.setattr(launch, "_pool", lambda *_: SimpleNamespace(put=put))

    def launched():
        handed.clear()
        try:
            return marked()[0]
        finally:
            shared = launch._OF_THREAD.shared
            assert shared is None or not handed or (shared.ended and not shared.open and not shared.working)

    launched()
    number = 0
    while interrupted_at(number := number + 1, launched):
        assert bool((launched() == 1).all())  # the launch after it is whole
    assert number > 50


def test_queued_work_that_begins_late_touches_nothing(monkeypatch):
    """An interrupt between the queue and its thread: the range is processed by nobody, and not in freed memory."""
    queued = []

    def put(work):
        queued.append(work)
        raise KeyboardInterrupt

    monkeypatch.setattr(launch, "_pool", lambda *_: SimpleNamespace(put=put))
    torch.set_num_threads(2)
    visits, firsts = torch.zeros(2, 30_000, dtype=torch.int32).unbind()
    with pytest.raises(KeyboardInterrupt):
        launch.launch(mark, 30_000, [visits, firsts], torch.device("cpu"))
    (late,) = queued
    late()
    assert not visits.any() and not late.__self__.inputs  # the queue holds no tensor


def test_a_second_interrupt_waits_too(monkeypatch):
    """It comes while the first one waits for a thread, which is still at work."""
    begun, ended, finish, finished = threading.Event(), threading.Event(), launch._SharedLaunch.finish, []

    def work(shared):
        if threading.current_thread() is threading.main_thread():
            begun.wait(10)
            raise KeyboardInterrupt("first")
        begun.set()
        ended.wait(10)

    def interrupted(shared):
        if not finished:
            finished.append("interrupted")
            raise KeyboardInterrupt("second")
        ended.set()
        finish(shared)
        finished.append(shared.working)

    monkeypatch.setattr(launch._SharedLaunch, "work", work)
    monkeypatch.setattr(launch._SharedLaunch, "finish", interrupted)
    monkeypatch.setattr(launch, "_OF_THREAD", launch._OfThread())
    torch.set_num_threads(2)
    with pytest.raises(KeyboardInterrupt, match="second"):
        marked()
    assert finished == ["interrupted", 0]


def test_an_error_of_another_thread_is_raised(monkeypatch):
    work, failed = launch._SharedLaunch.work, threading.Event()

    def fails(shared):
        if threading.current_thread() is not threading.main_thread():
            failed.set()
            raise MemoryError
        failed.wait(10)
        work(shared)

    monkeypatch.setattr(launch._SharedLaunch, "work", fails)
    torch.set_num_threads(2)
    with pytest.raises(MemoryError):
        marked()


@pytest.mark.parametrize("wrong", [{"dtype": torch.float64}, {"device": "meta"}])
def test_a_recorded_launch_checks_type_and_device(device, wrong):
    """Kernels would read other numbers, or no memory; also where another type has the same address and shape."""
    right = {"dtype": torch.int32, "device": device}
    numbers, rest = torch.zeros(3, **right), torch.zeros(3, **right)
    launch.launch(mark, 3, [numbers, rest], device)
    other = torch.zeros(3, **right | wrong)
    for bad in (other, numbers.view(torch.float32)):
        with pytest.raises(TypeError, match=f"visits must be torch.int32 on {device.type}, not {bad.dtype} on {bad.device}"):
            launch.launch(mark, 3, [bad, rest], device)


@pytest.mark.filterwarnings("ignore:Accessing the data pointer of FakeTensor")
def test_tensors_without_kernels_or_memory_are_refused_by_name():
    """Before a launch is looked up: meta stands for mps, xpu and the others."""
    g, cam = cloud(30), camera(dtype=torch.float32)
    rasterize(g, cam)
    with pytest.raises(ValueError, match=r"means is on meta, but the kernels run on cpu and cuda only"):
        rasterize(g.to("meta"), cam)
    with pytest.raises(ValueError, match=r"camera.K is on meta, but the kernels"):
        rasterize(g, dataclasses.replace(cam, K=cam.K.to("meta")))
    with pytest.raises(ValueError, match="mark: the kernels run on cpu and cuda only, not on meta"):
        launch.launch(mark, 3, [], torch.device("meta"))
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        with pytest.raises(ValueError, match="means is a fake tensor, without memory"):
            rasterize(Gaussians(**{n: mode.from_tensor(t) for n, t in g.tensors().items()}), cam)
        with pytest.raises(ValueError, match="background is a fake tensor"):  # under their mode every new tensor is one
            rasterize(g, cam)


def test_a_launch_that_failed_is_recorded_anew(monkeypatch):
    """Under the lock, as a first one: it may have to be compiled."""
    locked, load = [], launch.load_module
    arguments = [torch.zeros(3, dtype=torch.int32) for _ in range(2)]

    def fails_once(*given):
        locked.append(launch._LOADING.locked())
        if len(locked) == 1:
            raise ResourceError("no memory")
        return load(*given)

    monkeypatch.setattr(launch, "_OF_THREAD", launch._OfThread())
    monkeypatch.setattr(launch, "load_module", fails_once)
    with pytest.raises(ResourceError):
        launch.launch(mark, 3, arguments, torch.device("cpu"))
    launch.launch(mark, 3, arguments, torch.device("cpu"))
    assert locked == [True, True]


@wp.kernel(enable_backward=False)
def tell_apart(
    begin: int, table: wp.array2d(dtype=wp.float32), numbers: wp.array(dtype=wp.float32), found: wp.array(dtype=wp.float32)
):
    i = begin + wp.tid()
    found[i] = wp.float32(table.shape[0] * 100 + table.shape[1]) + 1000.0 * table[i, 1] + 1000000.0 * numbers[i]


@wp.kernel(enable_backward=False)
def second_of_row(begin: int, entries: wp.array(dtype=wp.float32), step: int, found: wp.array(dtype=wp.float32)):
    i = begin + wp.tid()
    found[i] = wp.float32(entries.shape[0]) + 1000.0 * entries[i * step + 1]


def test_arguments_of_one_and_two_axes_share_the_memory_of_any_tensor():
    """Flat, and in rows: also slices at the same address, of the same shape, whose rows lie at other distances."""
    memory = torch.arange(60, dtype=torch.float32)
    for width in (5, 10, 5):
        image = memory.view(-1, 2, width)[:3]  # as of two rows of pixels
        part = image[..., :3]
        found = torch.zeros(6)
        launch.launch(tell_apart, 6, [part, image, found], torch.device("cpu"))
        wanted = 603 + 1000 * part.reshape(6, 3)[:, 1] + 1e6 * image.reshape(-1)[:6]
        assert torch.equal(found, wanted), width
        launch.launch(second_of_row, 6, [part, part.stride(-2), found], torch.device("cpu"))  # one axis spans what lies between
        assert torch.equal(found, 5 * width + 3 + 1000 * part.reshape(6, 3)[:, 1]), width
    column = memory.view(1, 6, 10).transpose(0, 1)  # of images one pixel wide; its stride there is that of no row
    for image in (column, column[..., :4]):
        found = torch.zeros(6)
        launch.launch(tell_apart, 6, [image, memory, found], torch.device("cpu"))
        wanted = 600 + image.shape[-1] + 1000 * image[:, 0, 1] + 1e6 * memory[:6]
        assert torch.equal(found, wanted), image.shape
    for none, shape in ((part[..., :0], (0, 0)), (part[:0], (0, 3))):
        assert [launch.as_array(none, wp.float32, axes).shape for axes in (2, 1)] == [shape, (0,)]


def test_check_names_what_disagrees():
    a, b = torch.zeros(2, 3), torch.zeros(4, 2)
    assert launch.check(a=(a, "N 3"), b=(b, "K N")) == {"N": 2, "K": 4}
    with pytest.raises(TypeError, match="a must be a torch tensor, not list"):
        launch.check(a=([1.0], "N"))
    with pytest.raises(TypeError, match=r"a must be float32 or float64, not torch\.int32"):
        launch.check(a=(a.int(), "N 3"))
    with pytest.raises(TypeError, match=r"b is torch\.float64 but a is torch\.float32"):
        launch.check(a=(a, "N 3"), b=(b.double(), "K N"))
    with pytest.raises(ValueError, match="b is on meta, but the kernels run"):
        launch.check(a=(a, "N 3"), b=(b.to("meta"), "K N"))
    for pattern in ("N", "N 3 1", "N 4", "N N", "3 3"):
        with pytest.raises(ValueError, match=r"a must have shape .* not \[2, 3\]"):
            launch.check(a=(a, pattern))
    with pytest.raises(ValueError, match=r"b must have shape \[N, 2\] \(N=2\), not \[4, 2\]"):
        launch.check(a=(a, "N 3"), b=(b, "N 2"))


def test_addresses_are_looked_up_when_the_kernel_runs(device):
    """Two tensors of any lengths are joined; another time they are others, also where a graph is replayed."""
    on_gpu = device.type == "cuda"
    table = wp.zeros(3, dtype=wp.uint64, device="cpu", pinned=on_gpu)
    out = torch.zeros(9, device=device)

    def work():
        fetch(table.ptr, 4, 7, out)

    graph = None
    for base in (0, 100, 200):
        first, second = base + torch.arange(4.0, device=device), base + 50 + torch.arange(3.0, device=device)
        third = base + 80 + torch.arange(2.0, device=device)
        table.numpy()[:] = first.data_ptr(), second.data_ptr(), third.data_ptr()
        if on_gpu and graph is None and base > 0:
            graph = CapturedGraph(work, torch.cuda.Stream())
            torch.cuda.synchronize()
        work() if graph is None else graph.replay()
        assert out.tolist() == [*first.tolist(), *second.tolist(), *third.tolist()]


# A module is compiled by one process while another that needs it waits; nothing is locked once it is loaded.

ROOT = Path(__file__).parent.parent.parent
OTHER = """
import torch
from tests.kernels.test_launch import load_module_mark
from warpgs.errors import ResourceError
from warpgs.kernels import launch
from warpgs.kernels import native as load_module
import warp
def refuse(*_, **__): raise AssertionError("compiled a second time")
warp._src.build.build_cpu = refuse
lock = load_module.lock_descriptor
def note(descriptor):
    print("waits", flush=True)
    lock(descriptor)
load_module.lock_descriptor = note
seen = torch.zeros(3, dtype=torch.int32)
launch.launch(load_module_mark, 3, [seen], torch.device("cpu"))
print(seen.tolist())
"""


@wp.kernel(enable_backward=False, module="unique")
def load_module_mark(begin: int, seen: wp.array(dtype=int)):
    i = begin + wp.tid()
    seen[i] = i + 1


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache for this process and those it starts; returns this version's folder."""
    folder = tmp_path / wp.config.version
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(folder))
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path))
    return folder


def test_two_processes_compile_a_module_once(cache):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path]), "CUDA_VISIBLE_DEVICES": ""}
    name, cpu = load_module_mark.module.get_module_identifier(1), wp.get_device("cpu")
    (cache / "locks").mkdir(parents=True)
    with native.exclusive(cache / "locks" / f"{name}.0"):
        other = subprocess.Popen([sys.executable, "-c", OTHER], env=environment, stdout=subprocess.PIPE, text=True)
        assert other.stdout.readline() == "waits\n"
        load_module_mark.module.load(cpu, block_dim=1)
    assert other.communicate()[0] == "[1, 2, 3]\n" and other.returncode == 0


@wp.func
def doubled_sum(count: int) -> int:
    total = count
    for i in range(3):
        total += wp.static(2 * i)
    return total


@wp.kernel(enable_backward=False, module="unique")
def first_of_two(begin: int, seen: wp.array(dtype=int)):
    seen[begin + wp.tid()] = doubled_sum(1)


@wp.kernel(enable_backward=False, module="unique")
def second_of_two(begin: int, seen: wp.array(dtype=int)):
    seen[begin + wp.tid()] = doubled_sum(2)


@pytest.mark.parametrize("empty", [False, True], ids=["no folder", "a folder without a binary"])
def test_a_module_has_its_name_whatever_was_compiled_before(cache, monkeypatch, empty):
    """Else a process that finds the first of two modules in the cache would not find the second, and compile it anew."""
    monkeypatch.setattr(native, "_LOADED", set())
    first_of_two.module.unload()
    name = native.module_name(second_of_two.module, 1)
    if empty:  # as of a processor of another kind with the same home folder
        (cache / native.module_name(first_of_two.module, 1)).mkdir(parents=True)
    native.load_module(first_of_two.module, wp.get_device("cpu"), 1)
    second_of_two.module.mark_modified()
    assert native.module_name(second_of_two.module, 1) == name


def test_a_loaded_module_takes_no_lock(cache, monkeypatch):
    seen = torch.zeros(3, dtype=torch.int32)
    for _ in range(2):
        launch.launch(load_module_mark, 3, [seen], torch.device("cpu"))
        monkeypatch.setattr(native, "exclusive", None)
    assert seen.tolist() == [1, 2, 3]


def test_a_listener_hears_of_modules_that_the_cache_lacks(cache, monkeypatch):
    """Once: not of one that the cache holds by now, nor after the block."""
    cpu, heard, took = wp.get_device("cpu"), [], []
    for _ in range(2):
        monkeypatch.setattr(native, "_LOADED", set())
        load_module_mark.module.unload()
        with native.told_of_compiling(heard.append) as seconds:
            native.load_module(load_module_mark.module, cpu, 1)
        took.append(len(seconds))
        assert heard == [load_module_mark.module.get_module_identifier(1)]
    assert not native._LISTENERS and took == [1, 0]


def test_a_long_wait_for_modules_is_announced_once(cache, monkeypatch):
    """Where no listener tells of it, as in `rasterize` from Python: also not of the modules of a later backward pass."""
    said, came = [], threading.Event()
    monkeypatch.setattr(native, "say", lambda line, error: (said.append((line, error)), came.set()))
    native._say_compiling.cache_clear()

    class Slow:
        name = "slow"

        def get_module_identifier(self, block_dim):
            return f"slow_{len(said)}"

        def load(self, device, block_dim):
            assert came.wait(20)
            time.sleep(0.05)  # longer than `SILENT`

    def load(clock):
        monkeypatch.setattr(native.time, "perf_counter", lambda: clock)
        native.load_module(Slow(), wp.get_device("cpu"), 1)

    monkeypatch.setattr(native, "SILENT", 0.01)
    load(1e9)
    load(1e9 + 0.005)
    assert [error for _, error in said] == [True] and "compiling kernels" in said[0][0]
    load(2e9)
    assert len(said) == 1
    native._say_compiling.cache_clear()
    with native.told_of_compiling(lambda name: None):
        load(3e9)
    assert len(said) == 1
    native._say_compiling()  # as it was before, for other tests


class Later:
    def __init__(self, name, flags, events, load):
        self.name, self.options, self.events, self.own_load = name, {"cpu_compiler_flags": flags}, events, load

    def get_module_identifier(self, block_dim):
        self.events.append(f"name {self.name}")
        return self.name

    def load(self, device, block_dim):
        self.events.append(f"load {self.name} in {threading.current_thread().name.partition('_')[0]}")
        loaded = self.own_load()
        Path(wp.config.kernel_cache_dir, self.name).mkdir(exist_ok=True)
        return loaded


def test_modules_that_the_cache_lacks_load_ahead(cache, monkeypatch):
    """In order and in threads, once all are named; a launch waits for its module, and has its error; the end begins none."""
    events, cpu, left = [], wp.get_device("cpu"), []
    asked, loading, ended = (threading.Event() for _ in range(3))

    def fail():
        raise ResourceError("no memory")

    def last():
        left.append(threading.current_thread().daemon)
        loading.set()
        assert ended.wait(20)

    monkeypatch.setattr(native, "usable_cores", lambda: 2)
    monkeypatch.setattr(native, "_LOADED", set())
    steps = {"first": lambda: asked.wait(20), "there": fail, "second": fail, "third": last, "fourth": fail}
    modules = {name: Later(name, "flags", events, step) for name, step in steps.items()}
    (cache / "there").mkdir(parents=True)
    with native.told_of_compiling(lambda name: asked.set()) as seconds:  # the launch waits, and says so
        with native.loaded_ahead([(m, cpu, 1) for m in modules.values()]):
            assert native.load_module(modules["first"], cpu, 1) and len(seconds) == 1
            assert loading.wait(20)
            with pytest.raises(ResourceError, match="no memory"):
                native.load_module(modules["second"], cpu, 1)
            native._AHEAD[modules["fourth"], cpu.context, 1].add_done_callback(lambda cancelled: ended.set())
    names, loads = ([e for e in events if e.startswith(kind)] for kind in ("name", "load"))
    assert events[: len(steps)] == [f"name {name}" for name in steps] and len(names) > len(steps) and not native._AHEAD
    assert loads[0] == "load first in compile" and "load second in MainThread" in loads
    assert [e.split()[1] for e in loads if e.endswith("compile")] == ["first", "second", "third"]
    assert left == [False]  # the process waits for it: a compiler that is at work when the libraries close ends in a crash


def test_the_last_modules_are_begun_once_the_others_are_done(cache, monkeypatch):
    """Also those with other compiler flags, which another thread compiles; an error ends the wait for those not begun."""
    events, cpu = [], wp.get_device("cpu")
    begun, go = threading.Event(), threading.Event()
    monkeypatch.setattr(native, "usable_cores", lambda: 2)
    monkeypatch.setattr(native, "_LOADED", set())
    steps = {"first": lambda: begun.set() or go.wait(20), "second": lambda: True, "other": lambda: True}
    for name, error in (("", None), ("again", KeyboardInterrupt)):
        modules = [Later(f"{kind}{name}", kind == "other", events, step) for kind, step in steps.items()]
        with pytest.raises(error) if error else contextlib.nullcontext():
            with native.loaded_ahead([(m, cpu, 1) for m in modules], later=1):
                assert begun.wait(20) and not go.wait(0.2) and not any(e.startswith("load other") for e in events)
                if error:
                    raise error
                go.set()
                assert native.load_module(modules[2], cpu, 1)
        go.set()
        for thread in [t for t in threading.enumerate() if t.name.startswith("compile")]:
            thread.join(20)
        assert not any(t.name.startswith("compile") for t in threading.enumerate())
        loads = [e.split()[1].removesuffix(name) for e in events if e.endswith("compile")]
        assert loads == (["first", "other"] if error else ["first", "second", "other"])
        events.clear(), begun.clear(), go.clear()


def test_after_an_error_none_waits_for_a_module(cache, monkeypatch):
    """Not the block for the module at hand, and no thread for one that was not begun: it loads that itself."""
    events, cpu = [], wp.get_device("cpu")
    begun, asked, ended = (threading.Event() for _ in range(3))
    monkeypatch.setattr(native, "usable_cores", lambda: 2)
    monkeypatch.setattr(native, "_LOADED", set())
    steps = {"first": lambda: begun.set() or ended.wait(20), "second": lambda: "loaded"}
    modules = {name: Later(name, "flags", events, step) for name, step in steps.items()}
    (cache / "locks").mkdir(parents=True)
    with ThreadPoolExecutor(1) as other, native.told_of_compiling(lambda name: asked.set()):
        with pytest.raises(KeyboardInterrupt), native.loaded_ahead([(m, cpu, 1) for m in modules.values()]):
            launched = other.submit(native.load_module, modules["second"], cpu, 1)
            assert begun.wait(20) and asked.wait(20)
            raise KeyboardInterrupt
        assert launched.result(20) == "loaded" and not native._AHEAD
        ended.set()
    assert next(e for e in events if e.startswith("load second")).startswith("load second in ThreadPoolExecutor")


def test_a_lock_that_is_not_supported_is_no_obstacle_and_one_without_a_file_has_a_remedy(tmp_path, monkeypatch):
    def refuse(_):
        raise OSError(95, "not supported")

    monkeypatch.setattr(native, "lock_descriptor", refuse)
    with native.exclusive(tmp_path / "lock"):
        pass
    with pytest.raises(OSError, match="of the body"), native.exclusive(tmp_path / "lock"):
        raise OSError("of the body")
    with pytest.raises(ResourceError, match="WARP_CACHE_PATH"), native.exclusive(tmp_path / "no" / "lock"):
        pytest.fail("held")
