"""Stage files: YAML in, stages out, each value knowing its place in the file, as with rule files."""

from pathlib import Path

from patterns.files.loading import read_document, read_text, stage_files
from patterns.language.text import Document
from patterns.stages.settings import Stage


def load_stages(path: Path) -> list[Stage]:
    """The stage of a file, or the stages among all `*.yaml` and `*.yml` files of a directory, by file name.

    Raises:
        RuleError: A file that is not a stage, or two stages of one name.
        OSError: A file that cannot be read.
    """
    stages: dict[str, Stage] = {}
    for file in stage_files(Path(path)):
        stage = load_stage(file)
        if stage.stage in stages:
            raise stage.error(f"stage {stage.stage!r} is also defined in {stages[stage.stage].path}", "stage")
        stages[stage.stage] = stage
    return list(stages.values())


def load_stage(path: Path) -> Stage:
    """The stage of one file.

    Raises:
        RuleError: The file is not a stage.
        OSError: The file cannot be read.
    """
    path = Path(path)
    return parse_stage(read_text(path), str(path), path)


def parse_stage(text: str, name: str = "<stage>", path: Path | None = None) -> Stage:
    """The stage that a YAML text says; `name` stands for the file in errors, `path` where its test data lie.

    Raises:
        RuleError: The text is not a stage.
    """
    stage, passages = read_document(Document(name, text), Stage)
    return stage.loaded_from(path, passages)
