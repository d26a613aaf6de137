"""`vian doctor`: what stands in the way, and the next command."""

import typer

from vian import options
from vian.doctor import examine
from vian.errors import WorldFailed
from vian.findings import Verdict
from vian.options import open_from, settings_for
from vian.output import Output, counted


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(epilog="Example: vian doctor --data-dir /var/lib/vian")(doctor)


def doctor(data_dir: options.DataDir = None, dsn: options.Dsn = None, as_json: options.Json = False) -> None:
    """Examine this installation and its log; exit code 1 if something stands in the way."""
    settings = settings_for(data_dir, dsn)
    is_embedded = settings.dsn is None or data_dir is not None
    findings = examine(settings, lambda: open_from(settings, data_dir=data_dir), is_embedded=is_embedded)
    output = Output(is_json=as_json)
    bad = 0
    for finding in findings:
        bad += finding.verdict is Verdict.BAD
        output.result(
            {"check": finding.check, "verdict": finding.verdict, "text": finding.text},
            f"{finding.verdict.value:4}  {finding.check}: {finding.text}",
        )
    if bad:
        raise WorldFailed(f"{counted(bad, 'check')} came out bad; each says what to do next")
