"""Blocks hand out what was measured: apart, aligned, at the same places each time."""

import torch
import warp as wp

from warpgs.runtime import interop
from warpgs.runtime.allocator import ALIGNMENT, TORCH, Arena, SizingAllocator, fetch, part

CPU = torch.device("cpu")
BYTE = torch.empty(0, dtype=torch.uint8)


def ask(allocator):
    """Two tensors for the caller, three that are kept, two for a while; one of each kind with an odd size."""
    own = [allocator.output((3, 5), torch.float32, CPU), allocator.output((7,), torch.int32, CPU)]
    kept = [allocator.saved(s, t, CPU) for s, t in (((11,), torch.int64), ((0,), torch.float32), ((2, 33), torch.float32))]
    return own, kept, [allocator.workspace((1,), torch.int32, CPU), allocator.workspace((2, 3, 4), torch.float64, CPU)]


def test_blocks_give_shapes_that_were_measured_each_its_own_memory():
    """What is written to one changes no other."""
    measured = SizingAllocator()
    wanted = [[(tuple(t.shape), t.dtype) for t in kind] for kind in ask(measured)]
    blocks = Arena(measured, BYTE)
    found = ask(blocks)
    assert [[(tuple(t.shape), t.dtype) for t in kind] for kind in found] == wanted
    assert [[(tuple(t.shape), t.dtype) for t in kind] for kind in ask(TORCH)] == wanted
    every = [t for kind in found for t in kind]
    for number, t in enumerate(every):
        t.fill_(number)
    assert all(bool((t == number).all()) for number, t in enumerate(every))
    assert all(a is b for a, b in zip(blocks.outputs, found[0], strict=True))


def test_kept_tensors_are_found_again_in_any_such_block():
    """At multiples of ALIGNMENT, by place alone."""
    measured = SizingAllocator()
    ask(measured)
    first, second = Arena(measured, BYTE), Arena(measured, BYTE)
    places = [first.place(t) for t in ask(first)[1]]
    assert all(begin % ALIGNMENT == 0 for begin, _, _ in places) and len({begin for begin, _, _ in places}) >= 2
    _, kept, _ = ask(second)
    for number, t in enumerate(kept):
        t.fill_(number + 1)
    assert all(torch.equal(part(second.block, *place), t) for place, t in zip(places, kept, strict=True))


def test_addresses_name_all_memory():
    """Those of the caller's tensors and of both blocks; other blocks have others."""
    measured = SizingAllocator()
    ask(measured)
    blocks = Arena(measured, BYTE)
    own, kept, scratch = ask(blocks)
    assert blocks.addresses() == tuple(t.data_ptr() for t in (*own, kept[0], scratch[0]))
    assert Arena(measured, BYTE).addresses() != blocks.addresses()


def test_addresses_are_looked_up_when_the_kernel_runs(device):
    """Two tensors behind each other, of any lengths; the second time they are others, in a recorded launch too."""
    on_gpu = device.type == "cuda"
    table = wp.zeros(2, dtype=wp.uint64, device="cpu", pinned=on_gpu)
    out = torch.zeros(7, device=device)

    def work():
        fetch(table.ptr, 4, out)

    graph = None
    for base in (0, 100, 200):
        first, second = base + torch.arange(4.0, device=device), base + 50 + torch.arange(3.0, device=device)
        table.numpy()[:] = first.data_ptr(), second.data_ptr()
        if on_gpu and graph is None and base > 0:
            with torch.cuda.stream(torch.cuda.Stream()):
                graph, _ = interop.capture(work)
            torch.cuda.synchronize()
        work() if graph is None else graph.replay()
        assert out.tolist() == [*first.tolist(), *second.tolist()]
