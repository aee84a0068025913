"""The lines of a Dockerfile that run without Docker: those of a target, in their order, in a clean folder."""

from tools.run_dockerfile import ROOT, instructions, of_target, run

TEXT = """
FROM somewhere AS base
# a comment
RUN apt-get update \\
    && apt-get install everything
USER me
ENV WHERE=/opt/warpgs/a
RUN mkdir -p /opt/warpgs/a
FROM base AS cpu
ARG NAME=b
RUN touch "$WHERE/$NAME"
FROM base AS cuda
RUN false
"""


def test_lines_of_a_target_run_in_the_folder_and_those_of_root_do_not(tmp_path, monkeypatch):
    monkeypatch.setattr("tools.run_dockerfile.CHECK", "true")
    steps = of_target(instructions(TEXT), "cpu")
    assert [word for word, _ in steps] == ["RUN", "USER", "ENV", "RUN", "ARG", "RUN"]
    (left_out,) = run(steps, tmp_path, {"NAME": "c"})
    assert "apt-get install everything" in left_out and [p.name for p in (tmp_path / "a").iterdir()] == ["c"]


def test_the_dockerfile_has_both_targets_and_runs_as_no_root():
    """Only the system's libraries are installed before USER; every file that COPY names is there."""
    found = instructions((ROOT / "Dockerfile").read_text("utf-8"))
    for target in ("cpu", "cuda"):
        steps = of_target(found, target)
        words = [word for word, _ in steps]
        assert words.count("USER") == 1 and words[: words.index("USER")] == ["RUN"] and words[-1] == "CMD"
        for rest in (rest for word, rest in steps if word == "COPY"):
            assert all((ROOT / name).exists() for name in rest.split()[:-1] if not name.startswith("--"))
