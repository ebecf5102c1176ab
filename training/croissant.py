"""Metadata of a recorded set in Croissant 1.0 (MLCommons), with the field of its RAI vocabulary on how data were collected."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

NAME = "croissant.json"
ENCODINGS = {".parquet": "application/x-parquet", ".hdf5": "application/x-hdf5", ".mp4": "video/mp4", ".json": "application/json"}
KINDS = {"float": "sc:Float", "double": "sc:Float", "int": "sc:Integer", "bool": "sc:Boolean", "struct": "sc:ImageObject"}
# the vocabulary's own context, key by key
PLAIN = """citeAs column containedIn equivalentProperty extract field fileObject fileProperty fileSet format includes isLiveDataset
jsonPath key md5 parentField path recordSet references regex repeated replace samplingRate separator source subField transform"""
CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "dct": "http://purl.org/dc/terms/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **{name: f"cr:{name}" for name in PLAIN.split()},
}


def describe(folder: Path, about: dict[str, Any]) -> None:
    """Write the metadata of a set beside it: its files with their checksums and, of LeRobot's format, the columns of its frames.

    about: what the recording is.  The license is for whoever publishes the set to add.
    """
    paths = sorted(path for path in folder.rglob("*") if path.suffix in ENCODINGS)
    name = about["name"].replace("/", "_")
    collected = (
        f"Simulated with clothgym {about['versions']['clothgym']}: {about['episodes']} episodes of {about['env']}, from seed "
        f"{about['seed']} on, with the policy {about['policy']!r} and noise {about['noise']}; keyword arguments "
        f"{json.dumps(about['env_kwargs'])}, observations {about['obs_mode']}; failed episodes: {about['failed']}."
    )
    content: dict[str, Any] = {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": ["http://mlcommons.org/croissant/1.0", "http://mlcommons.org/croissant/RAI/1.0"],
        "name": name,
        "description": f"{about['task']} {collected}",
        "keywords": ["cloth", "robot learning", "imitation learning", "simulation"],
        "version": "1.0.0",
        "rai:dataCollection": collected,
        "distribution": [_file(folder, path) for path in paths],
    }
    frames = [path.relative_to(folder).as_posix() for path in paths if path.match("data/*/*.parquet")]
    if frames:
        content["distribution"].append(
            {"@type": "cr:FileSet", "@id": "frames", "includes": "data/*/*.parquet", "encodingFormat": ENCODINGS[".parquet"]}
            | {"containedIn": [{"@id": one} for one in frames]}
        )
        content["recordSet"] = [_records(folder / frames[0])]
    (folder / NAME).write_text(json.dumps(content, indent=1) + "\n")


def _file(folder: Path, path: Path) -> dict[str, Any]:
    name = path.relative_to(folder).as_posix()
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    about = {"@type": "cr:FileObject", "@id": name, "name": name, "contentUrl": name, "contentSize": f"{path.stat().st_size} B"}
    return about | {"encodingFormat": ENCODINGS[path.suffix], "sha256": digest}


def _records(path: Path) -> dict[str, Any]:
    """The frames' columns, from one of their files."""
    import pyarrow.parquet as pq

    fields = []
    for column in pq.read_schema(path):
        kind, repeated = column.type, False
        while hasattr(kind, "value_type"):
            kind, repeated = kind.value_type, True
        source = {"fileSet": {"@id": "frames"}, "extract": {"column": column.name}}
        field = {"@type": "cr:Field", "@id": f"frames/{column.name}", "name": column.name, "repeated": repeated, "source": source}
        fields.append(field | {"dataType": next(own for name, own in KINDS.items() if str(kind).startswith(name))})
    return {"@type": "cr:RecordSet", "@id": "frame", "name": "frame", "field": fields}
