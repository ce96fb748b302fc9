"""The files that platforms read: citation, forms for issues, the workflow; and the repository's one address."""

import re
import subprocess
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
GITHUB = ROOT / ".github"
CONFIGURATION = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = CONFIGURATION["project"]
TOWNCRIER = CONFIGURATION["tool"]["towncrier"]
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
    tests = {
        "scripts/test",
        *(f"scripts/test {tier}" for tier in ("unit", "statistical", "tests/firmware", "clients ros2")),
    }
    assert scripts_of(workflow) == {"scripts/check", *tests, "scripts/docs", "scripts/audit"}
    nightly = {name: job.get("if", "always").endswith("== 'schedule'") for name, job in workflow["jobs"].items()}
    assert [name for name, is_nightly in nightly.items() if is_nightly] == ["statistical"]
    assert "if" not in workflow["jobs"]["audit"]


def scripts_of(workflow):
    """The scripts of the repository that a workflow runs; each job has a limit of time."""
    for job in workflow["jobs"].values():
        assert job.keys() >= {"runs-on", "timeout-minutes", "steps"}
    runs = {step["run"] for job in workflow["jobs"].values() for step in job["steps"] if "run" in step}
    lines = {line for line in runs if line.startswith("scripts/")}
    for line in lines:
        assert (ROOT / line.split()[0]).stat().st_mode & 0o111, line
    return lines


def test_only_a_tag_publishes_and_only_what_was_tried():
    workflow = loaded(GITHUB / "workflows" / "publish.yml")
    assert workflow[True] == {"push": {"tags": ["v*"]}}
    assert scripts_of(workflow) == {"scripts/publish --dry-run", "scripts/publish --dry-run --made"}
    *tries, publish = workflow["jobs"].values()
    assert workflow["permissions"] == {}
    assert [job["permissions"] for job in tries] == [{"contents": "read"}] * 2
    assert publish["permissions"] == {"id-token": "write"}
    assert (publish["environment"], publish["needs"]) == ("pypi", ["build", "aarch64"])


def test_dependencies_are_updated_every_week_in_groups():
    updates = loaded(GITHUB / "dependabot.yml")["updates"]
    assert {update["package-ecosystem"] for update in updates} == {"uv", "github-actions"}
    assert all(update["schedule"] == {"interval": "weekly"} and update["groups"] for update in updates)


@pytest.mark.site
def test_the_script_publishes_nothing():
    done = subprocess.run([ROOT / "scripts" / "publish", "--made"], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "publishing is done by .github/workflows/publish.yml" in done.stderr


def test_paths_that_the_guide_names_exist():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    paths = set(re.findall(r"(?<![\w./])(?:tests|scripts|benchmarks|docs|changes|\.github)/[\w./-]*\w/?", text))
    paths |= set(re.findall(r"`([\w-]+\.(?:py|toml|md|lock|cff))`", text))
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_the_changelog_has_the_version_and_the_mark_of_towncrier():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert TOWNCRIER["start_string"] in text
    assert re.search(r"^## (\S+) \(", text, re.MULTILINE)[1] == PROJECT["version"]
    assert (ROOT / TOWNCRIER["directory"] / "README.md").exists()


def test_every_file_names_the_same_repository():
    found = set()
    for path in (*ROOT.glob("*.md"), ROOT / "CITATION.cff", ROOT / "pyproject.toml", *GITHUB.rglob("*.*")):
        found.update(re.findall(r"https://github\.com/skyless[\w-]*/[\w-]+", path.read_text(encoding="utf-8")))
    assert found == {ADDRESS}
    assert all(url.startswith(ADDRESS) for url in PROJECT["urls"].values())
