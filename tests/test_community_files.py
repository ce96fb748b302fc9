"""The files that platforms read: citation, forms for issues, the workflow; and the repository's one address."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
GITHUB = ROOT / ".github"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
ADDRESS = PROJECT["urls"]["Repository"]
FORMS = sorted(path for path in (GITHUB / "ISSUE_TEMPLATE").glob("*.yml") if path.name != "config.yml")


def loaded(path):
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def test_the_citation_names_software_and_paper():
    citation = loaded(ROOT / "CITATION.cff")
    assert citation.keys() >= {"cff-version", "message", "title", "authors", "version", "license", "repository-code"}
    assert citation["version"] == PROJECT["version"]
    assert citation["license"] == PROJECT["license"]
    (paper,) = citation["references"]
    assert paper.keys() >= {"type", "title", "authors", "year", "doi", "collection-title"}
    assert [author["family-names"] for author in paper["authors"]] == ["Santoro", "Nardello", "Brunelli", "Fontanelli"]
    assert paper["doi"] in (ROOT / "docs" / "errata.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.stem)
def test_a_form_has_what_github_requires(path):
    form = loaded(path)
    assert form.keys() >= {"name", "description", "body"}
    fields = [field for field in form["body"] if field["type"] != "markdown"]
    names = [field["id"] for field in fields]
    assert len(names) == len(set(names))
    for field in form["body"]:
        assert field["type"] in {"markdown", "input", "textarea", "dropdown", "checkboxes"}
        assert ("value" if field["type"] == "markdown" else "label") in field["attributes"]
        assert field["type"] != "dropdown" or len(field["attributes"]["options"]) > 1
    assert any(field.get("validations", {}).get("required") for field in fields)


def test_a_bug_comes_with_its_version_and_its_recording():
    fields = {field.get("id"): field for field in loaded(GITHUB / "ISSUE_TEMPLATE" / "bug.yml")["body"]}
    assert "skyless --version" in fields["version"]["attributes"]["description"]
    assert "skyless record" in fields["recording"]["attributes"]["description"]


def test_the_workflow_runs_the_scripts_of_the_repository():
    workflow = loaded(GITHUB / "workflows" / "ci.yml")
    assert workflow.keys() >= {"name", True, "permissions", "jobs"}  # YAML 1.1 reads the key ``on`` as true
    assert workflow["jobs"]["test"]["strategy"]["matrix"]["python"] == ["3.11", "3.13"]
    lines = {step["run"] for job in workflow["jobs"].values() for step in job["steps"] if "run" in step}
    assert lines == {"scripts/check", "scripts/test unit", "scripts/test", "scripts/docs", "scripts/audit"}
    for line in lines:
        assert (ROOT / line.split()[0]).stat().st_mode & 0o111, line
    for job in workflow["jobs"].values():
        assert job.keys() >= {"runs-on", "timeout-minutes", "steps"}


def test_every_file_names_the_same_repository():
    found = set()
    for path in (*ROOT.glob("*.md"), ROOT / "CITATION.cff", ROOT / "pyproject.toml", *GITHUB.rglob("*.*")):
        found.update(re.findall(r"https://github\.com/skyless[\w-]*/[\w-]+", path.read_text(encoding="utf-8")))
    assert found == {ADDRESS}
    assert all(url.startswith(ADDRESS) for url in PROJECT["urls"].values())
