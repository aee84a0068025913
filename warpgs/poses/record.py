"""Records of found poses: poses.json, which warpgs reads again, and poses.txt for people."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from warpgs import schema
from warpgs.errors import DataError
from warpgs.files import write_json, write_text
from warpgs.poses.advice import advice, partners, reason
from warpgs.poses.mapping import Mapping
from warpgs.poses.photographs import Photograph

JSON, TEXT = "poses.json", "poses.txt"
FORMAT = 1
"""Number of the format of poses.json."""
SHOWN_PARTNERS = 5
"""Largest number of matched photographs that the record names for a photograph."""
FEW = 5
"""Largest number of photographs for which a focal length without EXIF is called uncertain (decision 017)."""
_PHOTOGRAPH = schema.fields(
    {
        "name": schema.text, "sha256": schema.text, "registered": schema.flag, "keypoints": schema.whole(0),
        "points": schema.whole(0), "matches": schema.mapping(schema.whole(1)), "reason": schema.or_null(schema.text),
    },
)  # fmt: skip
_RECORD = schema.fields(
    {
        "format": schema.one_of(FORMAT), "source_sha256": schema.text, "photographs": schema.items(_PHOTOGRAPH),
        "notes": schema.items(schema.text), "advice": schema.items(schema.text),
        "mean_reprojection_error_px": schema.number(0), "points": schema.whole(0),
        "method": schema.one_of("incremental", "global"), "pairs_tried": schema.whole(0), "pairs_matched": schema.whole(0),
        "cameras": schema.items(schema.fields({
            "focal": schema.number(above=0), "distortion": schema.number(), "width": schema.whole(1), "height": schema.whole(1),
        })), "pycolmap": schema.text,
    },
)  # fmt: skip


def record_of(found: Mapping, photographs: Sequence[Photograph], digest: str, notes: Sequence[str]) -> dict[str, Any]:
    """Return the contents of poses.json; ``digest`` is the hash of the source, ``notes`` are choices made for the user."""
    names = [p.name for p in photographs]
    rows = []
    for i, p in enumerate(photographs):
        registered = i in found.views
        rows.append({
            "name": p.name, "sha256": p.digest, "registered": registered, "keypoints": found.keypoints[i],
            "points": found.views[i].points if registered else 0,
            "matches": {names[j]: n for j, n in partners(found, i)[:SHOWN_PARTNERS]},
            "reason": None if registered else reason(found, i, names),
        })  # fmt: skip
    remarks = [summary(found, len(names))]
    if found.kept_focal:
        remarks.append(f"the focal length is taken from EXIF, because {len(found.views)} photographs cannot improve it")
    elif found.kept_focal is False:
        remarks.append(
            f"the EXIF focal length does not fit the {len(found.views)} photographs, which may be cropped; the focal length "
            "was estimated instead. Such an estimate is often 5 % off, at worst 20 % or more"
        )
    elif len(found.views) <= FEW and any(photographs[i].focal is None for i in found.views):
        remarks.append(
            f"EXIF holds no focal length. An estimate from {len(found.views)} photographs is often 5 % off, at worst 20 % or "
            "more, and so is depth. Add photographs from more directions"
        )
    if found.method == "global":
        remarks.append(
            "global mapping is used, because it joined more photographs than incremental mapping; results of global mapping "
            "differ a little from run to run"
        )
    return {
        "format": FORMAT, "source_sha256": digest, "photographs": rows,
        "notes": [*notes, *remarks],
        "advice": advice(found, names), "mean_reprojection_error_px": found.error, "points": found.points,
        "method": found.method, "pairs_tried": found.tried, "pairs_matched": len([n for n in found.matches.values() if n]),
        "cameras": [dict(vars(c)) for c in found.cameras], "pycolmap": found.version,
    }  # fmt: skip


def summary(found: Mapping, count: int) -> str:
    """Return a sentence on how many of ``count`` photographs have a pose, and how well they fit."""
    focal = ", ".join(f"{c.focal:.0f} px of {max(c.width, c.height)}" for c in found.cameras)
    return (
        f"poses found for {len(found.views)} of {count} photographs from {found.points:,} points, mean reprojection error "
        f"{found.error:.2f} px, {found.method} mapping, focal length {focal}"
    )


def report_lines(record: dict[str, Any]) -> list[str]:
    """Return a record as lines of text: the choices, each photograph, and what to photograph next."""
    rows = record["photographs"]
    width = max((len(p["name"]) for p in rows), default=0)
    lines = [*record["notes"], ""]
    for p in rows:
        best = ", ".join(f"{name} ({n})" for name, n in list(p["matches"].items())[:2])
        if p["registered"]:
            lines.append(
                f"{p['name']:<{width}}  pose    {p['keypoints']:>6,} keypoints, {p['points']:>5,} points, matches {best}"
            )
        else:
            lines.append(f"{p['name']:<{width}}  NO POSE: it {p['reason']}")
    lines += [
        "",
        "What to photograph next:" if record["advice"] else "Nothing more is needed: all photographs are well linked.",
    ]
    return lines + [f"- {a}" for a in record["advice"]]


def write_record(folder: Path, record: dict[str, Any]) -> None:
    """Write poses.json and poses.txt into a folder.

    Raises:
        ResourceError: The disk is full.
    """
    write_json(folder / JSON, record)
    write_text(folder / TEXT, "\n".join(report_lines(record)) + "\n")


def read_record(folder: Path) -> dict[str, Any]:
    """Read poses.json of a scene whose poses were found.

    Raises:
        DataError: The record is missing or incomplete.
    """
    path = folder / JSON
    try:
        record: dict[str, Any] = schema.read(path, folder)
        _RECORD(record, "")
    except (OSError, schema.SchemaError) as e:
        raise DataError(f"{path}: cannot be read ({e}); find the poses again with `warpgs poses`") from e
    return record
