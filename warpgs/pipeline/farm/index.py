"""Results of a farm: index.html and results.csv, from the records of all its jobs."""

from __future__ import annotations

import csv
import io
import os
import time
from dataclasses import replace
from pathlib import Path

from warpgs.files import write_text
from warpgs.pipeline.farm.farm import JobStatus
from warpgs.pipeline.farm.record import PLY, THUMBNAIL
from warpgs.report.farm_page import JobCard, write_farm_page
from warpgs.report.farm_table import JobRow

INDEX, TABLE = "index.html", "results.csv"
COLUMNS = (
    "name", "scene", "state", "how", "psnr", "ssim", "gaussians", "steps", "ply_bytes", "seconds", "ply_sha256", "message",
)  # fmt: skip
"""Columns of results.csv."""


def row_of(status: JobStatus) -> JobRow:
    """Return the row of a job in tables."""
    record = status.record
    if record is None:
        took = time.monotonic() - status.began if status.state == "running" else 0.0
        return JobRow(status.job.name, status.state, status.step, took, message=status.notes[-1] if status.notes else "")
    message = record.message if record.state == "failed" else "" if status.attempts else "finished before"
    return JobRow(
        record.name, status.state, record.steps, record.seconds, record.psnr, record.gaussians,
        message or (status.notes[-1] if status.notes else ""),
    )  # fmt: skip


def write_index(folder: Path, statuses: list[JobStatus], seconds: float) -> None:
    """Write index.html and results.csv of a farm.

    Args:
        folder: Folder of the results.
        statuses: The jobs.
        seconds: Time since the farm began [s].

    Raises:
        ResourceError: A file cannot be written.
    """
    cards = []
    for status in statuses:
        record, job = status.record, status.job
        row = row_of(status)
        shown = replace(
            row, message=row.message.replace(f"{Path(job.request.scene.path).parent}{os.sep}", "")
        )  # a page is sent
        thumbnail, report = job.folder / THUMBNAIL, job.request.out / "report.html"
        cards.append(JobCard(
            shown, record.ssim if record else None, record.ply_bytes if record else 0,
            thumbnail.relative_to(folder).as_posix() if thumbnail.is_file() else "",
            report.relative_to(folder).as_posix() if report.is_file() else "",
        ))  # fmt: skip
    write_farm_page(folder / INDEX, folder.resolve().name, cards, seconds)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for status in statuses:
        r, scene = status.record, status.job.request.scene.path
        if r is None:
            writer.writerow([status.job.name, scene, status.state, *[""] * (len(COLUMNS) - 3)])
            continue
        sizes = ["" if v is None else v for v in (r.psnr, r.ssim, r.gaussians, r.steps, r.ply_bytes, round(r.seconds, 3))]
        writer.writerow([r.name, scene, r.state, r.how, *sizes, r.files.get(PLY, ""), r.message])
    write_text(folder / TABLE, text.getvalue())
