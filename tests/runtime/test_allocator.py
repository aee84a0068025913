"""Allocators: an arena gives a function its tensors again, apart, aligned, at the same places each time."""

import torch
import warp as wp

from warpgs.kernels.graphs import CapturedGraph
from warpgs.kernels.launch import ALIGNMENT, TORCH, Arena, SizingAllocator, fetch, part

CPU = torch.device("cpu")
BYTE = torch.empty(0, dtype=torch.uint8)


def ask(allocator):
    """Ask for two output, three saved and two workspace tensors; one of each kind has an odd size."""
    outputs = [allocator.output((3, 5), torch.float32, CPU), allocator.output((7,), torch.int32, CPU)]
    saved = [allocator.saved(s, t, CPU) for s, t in (((11,), torch.int64), ((0,), torch.float32), ((2, 33), torch.float32))]
    return outputs, saved, [allocator.workspace((1,), torch.int32, CPU), allocator.workspace((2, 3, 4), torch.float64, CPU)]


def test_an_arena_gives_the_same_shapes_and_each_its_own_memory():
    """A write to one tensor changes no other."""
    sizes = SizingAllocator()
    wanted = [[(tuple(t.shape), t.dtype) for t in kind] for kind in ask(sizes)]
    arena = Arena(sizes, BYTE)
    found = ask(arena)
    assert [[(tuple(t.shape), t.dtype) for t in kind] for kind in found] == wanted
    assert [[(tuple(t.shape), t.dtype) for t in kind] for kind in ask(TORCH)] == wanted
    every = [t for kind in found for t in kind]
    for number, t in enumerate(every):
        t.fill_(number)
    assert all(bool((t == number).all()) for number, t in enumerate(every))
    assert all(a is b for a, b in zip(arena.outputs, found[0], strict=True))


def test_saved_tensors_are_found_again_in_any_such_block():
    """Places are multiples of ALIGNMENT, and hold for every block of that size."""
    sizes = SizingAllocator()
    ask(sizes)
    first, second = Arena(sizes, BYTE), Arena(sizes, BYTE)
    places = [first.place(t) for t in ask(first)[1]]
    assert all(begin % ALIGNMENT == 0 for begin, _, _ in places) and len({begin for begin, _, _ in places}) >= 2
    _, saved, _ = ask(second)
    for number, t in enumerate(saved):
        t.fill_(number + 1)
    assert all(torch.equal(part(second.block, *place), t) for place, t in zip(places, saved, strict=True))


def test_addresses_name_all_memory():
    """They are those of the outputs and of both blocks; another arena has others."""
    sizes = SizingAllocator()
    ask(sizes)
    arena = Arena(sizes, BYTE)
    outputs, saved, workspace = ask(arena)
    assert arena.addresses() == tuple(t.data_ptr() for t in (*outputs, saved[0], workspace[0]))
    assert Arena(sizes, BYTE).addresses() != arena.addresses()


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
