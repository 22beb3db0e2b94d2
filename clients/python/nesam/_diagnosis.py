"""Diagnoses: what is asked, and what is heard."""

from typing import Optional

from . import _messages as m
from . import _types as t
from ._given import stamp, whole
from .v1 import diagnosis_pb2

REFERENCES = {"bundle": diagnosis_pb2.DIAGNOSIS_REFERENCE_BUNDLE, "physics": diagnosis_pb2.DIAGNOSIS_REFERENCE_PHYSICS}
"""What measurements are held against."""


def request(
    session_id: str,
    recording: str,
    from_stamp_ns: Optional[int],
    to_stamp_ns: Optional[int],
    seed: Optional[int],
    reference: str,
    controls: bool,
) -> diagnosis_pb2.StartDiagnosisRequest:
    """What `Client.diagnose` asks for. ValueError for an unknown reference, and a stamp or a seed that does not fit."""
    if reference not in REFERENCES:
        raise ValueError(f"reference {reference!r} must be one of {tuple(REFERENCES)}")
    return diagnosis_pb2.StartDiagnosisRequest(
        session_id=session_id,
        recording=recording,
        from_stamp_ns=None if from_stamp_ns is None else stamp(from_stamp_ns, "from_stamp_ns"),
        to_stamp_ns=None if to_stamp_ns is None else stamp(to_stamp_ns, "to_stamp_ns"),
        seed=None if seed is None else whole(seed, "seed", bits=64),
        reference=REFERENCES[reference],
        without_controls=not controls,
    )


def event(message: diagnosis_pb2.DiagnosisEvent) -> t.DiagnosisEvent:
    """What is told of a diagnosis."""
    kind = message.WhichOneof("event")
    if kind == "started":
        started = message.started
        return t.DiagnosisStarted(
            diagnosis_id=started.diagnosis_id,
            recording=started.recording,
            from_stamp_ns=started.from_stamp_ns if started.HasField("from_stamp_ns") else None,
            to_stamp_ns=started.to_stamp_ns if started.HasField("to_stamp_ns") else None,
        )
    if kind == "report":
        report = message.report
        return t.DiagnosisReport(
            diagnosis_id=report.diagnosis_id,
            verdict=diagnosis_pb2.DiagnosisVerdict.Name(report.verdict)[len("DIAGNOSIS_VERDICT_") :].lower(),
            reason=report.reason,
            effects=tuple(m.effect(one) for one in report.effects),
            json=report.json,
            folder=report.folder,
            bundle=report.bundle,
            bundle_hash=report.bundle_hash,
            notes=tuple(report.notes),
        )
    progress = message.progress
    return t.DiagnosisProgress(progress.stage, progress.done, progress.total)
