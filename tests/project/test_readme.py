"""What the README, the tutorials and the how-tos show runs: their Python, and every line of their shell blocks.

A line is run as it stands, or in a shorter form (``SHORTER``), or it names the test that runs it (``ELSEWHERE``). A new
line that is none of these is run, unless it is of a program that runs until Ctrl-C: then this test asks for its entry.
"""

import ast
import json
import re
import shlex
from pathlib import Path

import pytest
from PIL import Image

from skyless.cli.main import main, program
from support import live_site

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
PAGES = [README, *sorted(ROOT.glob("docs/tutorials/*.md")), *sorted(ROOT.glob("docs/howto/*.md"))]


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def commands(page):
    """The lines of a page's shell blocks in their order, without comments, continued lines joined."""
    lines = [line for block in blocks(page, "sh") for line in re.sub(r"\s*\\\n\s*", " ", block).splitlines()]
    return [command for line in lines if (command := re.sub(r"(^|\s+)#\s.*", "", line).strip())]


SHORTER = {
    "skyless plan hall.toml --plot hall.png --target 5": "skyless plan hall.toml --plot hall.png --target 5 --step 4",
    "skyless plan hall.toml --plot hall.png --target 10": "skyless plan hall.toml --plot hall.png --target 10 --step 4",
    "skyless plan flat.toml --plot flat.png --target 10": "skyless plan flat.toml --plot flat.png --target 10 --step 4",
    "skyless simulate --site hall.toml --tags 3 --duration 20": "skyless simulate --site hall.toml --duration 3",
    "skyless simulate --site hall.toml --tags 3 --duration 20 --loss 0.1 --outage 3:10": (
        "skyless simulate --site hall.toml --duration 3 --loss 0.1 --outage 3:1"
    ),
    "skyless simulate --scenario lab --noise-ps 100 --position 3,4 --fixes 3000 --seed 7": (
        "skyless simulate --scenario lab --noise-ps 100 --position 3,4 --fixes 30 --seed 7"
    ),
    "skyless simulate --site hall.toml --tags 20 --speed 1.5 --duration 60 --loss 0.1 --nlos 0.05": (
        "skyless simulate --site hall.toml --tags 2 --speed 1.5 --duration 3 --loss 0.1 --nlos 0.05"
    ),
    'skyless simulate --waypoints "1,1;5,1;5,7" --speed 0.5 --outage 1:10:15 --fixes-csv fixes.csv': (
        'skyless simulate --waypoints "1,1;5,1;5,7" --speed 0.5 --outage 1:2:3 --fixes-csv fixes.csv --duration 4'
    ),
    "skyless simulate --scenario room --tags 5": "skyless simulate --scenario room --tags 1 --duration 3",
    "skyless site keys new hall.toml": "skyless site keys new hall.toml --years 0.001",
    "skyless site keys rotate hall.toml": "skyless site keys rotate hall.toml --years 0.001",
    "skyless site keys revoke hall.toml --years 0.1": "skyless site keys revoke hall.toml --years 0.001",
}
"""Lines that take long, and what is run in their stead: less of the same."""

HTTP = "tests/page/test_http_doc.py::test_clients_of_a_running_server"
EVERYDAY_PAGE = ROOT / "docs" / "tutorials" / "everyday.md"
EVERYDAY = "tests/cli/test_everyday_tutorial.py::test_every_line_of_the_tutorial_runs"
USERS = "tests/project/test_as_users_do.py::test_the_readme_s_commands_on_a_fresh_copy"
DEMO = "tests/cli/test_demo_command.py::"
KEYED = "tests/run/test_no_key_leaves.py::test_no_key_leaves_the_programs"
SITE = "tests/run/test_running_site.py::test_a_site_rides_through_the_death_and_the_freezing_of_every_process"
BOARD = "tests/run/test_boards_live.py::"
WATCH = "tests/cli/test_site_watch.py::test_a_site_is_shown_in_a_pipe_as_json_and_on_a_terminal"
DOCTOR = "tests/run/test_doctor.py::"
BROKER = "tests/run/test_broker.py::"
ROLES = "tests/run/test_site_with_roles.py::"
MQTT = "tests/cli/test_node_commands.py::test_the_demo_tells_how_to_watch_its_broker"
PLAN = "tests/cli/test_plan_command.py::"
BENCHMARK = "tests/research/test_benchmark.py::"
REPLAY = "tests/cli/test_replay_command.py::"
ELSEWHERE = {
    "git clone https://github.com/skyless-uwb/skyless && cd skyless": "a copy of the files stands for the clone: "
    + USERS,
    **dict.fromkeys(("scripts/run", "scripts/test unit"), USERS),
    "scripts/run --version": "tests/cli/test_program.py::test_version",
    'export PATH="$PWD/.venv/bin:$PATH"': "the run that this test is part of",
    "skyless demo --duration 20 --record walk.mcap": (
        DEMO + "test_json_also_where_ports_are_taken_and_nothing_can_be_written_at_home"
    ),
    "skyless demo --site hall.toml --tags 3": DEMO
    + "test_programs_that_die_are_started_again_and_ctrl_c_ends_all_with_a_summary",
    "skyless watch": WATCH,
    "skyless watch --mqtt mqtts://page@hall.example": WATCH,
    "skyless watch --json": WATCH,
    "skyless doctor": DOCTOR,
    "skyless doctor --site hall.toml --report hall.md": DOCTOR,
    "skyless doctor --radio serial:/dev/ttyACM0 --mqtt none --duration 30": DOCTOR,
    **dict.fromkeys(commands(EVERYDAY_PAGE)[1:], EVERYDAY),
    "skyless broker": BROKER + "test_it_leaves_no_orphan_however_it_ends",
    **dict.fromkeys(("skyless ether", "skyless ether --site hall.toml --tags 2"), SITE),
    **dict.fromkeys(("skyless anchor 1 2 3 4 5 6", "skyless anchor 1 2 3 4 5 6 --site hall.toml"), SITE),
    "skyless tag tag1 tag2": SITE,
    "skyless anchor 3 --site hall.toml --keys /etc/skyless/keys": KEYED,
    "skyless tag tag1 --site-key site.public --trust verified": KEYED,
    "chmod 600 /etc/skyless/keys/*.seed": (
        "tests/run/test_key_files.py::test_a_secret_that_others_can_read_is_refused_with_what_to_do"
    ),
    "skyless dashboard": "tests/page/test_dashboard_end_to_end.py::test_a_site_is_found_shown_and_watched",
    "skyless dashboard --assets assets.csv": HTTP,
    "curl http://127.0.0.1:8080/api/v1/assets.csv > assets.csv": HTTP,
    "curl -T assets.csv http://127.0.0.1:8080/api/v1/assets.csv": HTTP,
    "skyless record walk.mcap": ("tests/run/test_record_command.py::test_a_recording_replays_and_ctrl_c_closes_it"),
    "skyless board tag1 --link /tmp/tag1": (
        "tests/cli/test_node_commands.py::test_a_board_tells_where_it_is_and_takes_its_link_with_it"
    ),
    "skyless tag tag1 --radio serial:/tmp/tag1": (
        BOARD + "test_anchors_and_tags_on_boards_make_the_fixes_of_those_on_the_air_and_survive_pulled_plugs"
    ),
    **dict.fromkeys(
        (
            "skyless flash-config --radio serial:/dev/ttyACM0 --mode tag --output nmea --rate-hz 10 --baud 115200",
            "skyless flash-config --radio serial:/tmp/tag1 --mode tag --rate-hz 50",
            "skyless flash-config --mode tag --sleep-s 1 --receive expected",
        ),
        "tests/radio/test_board_setup.py::test_the_command_shows_what_flash_holds",
    ),
    **dict.fromkeys(
        (
            "skyless tag tag1 --radio serial:/dev/ttyACM0@115200 --from-board",
            "skyless tag tag1 --radio serial:/tmp/tag1 --from-board --json",
        ),
        "tests/run/test_tag_on_board.py::test_fixes_states_and_alerts_of_a_board_are_published_and_written_as_lines",
    ),
    "skyless demo --boards 1": DEMO
    + "test_a_pipe_gets_the_places_and_the_tables_once_also_when_it_is_terminated_and_a_tag_is_a_board",
    **dict.fromkeys(
        ("gpsd -N -n /dev/ttyACM0", "cgps"),
        "tests/firmware/test_outputs.py::"
        "test_gpsd_has_the_position_and_its_errors_whether_the_board_knows_the_time_or_not",
    ),
    "mosquitto_sub -t 'skyless/#' -v": MQTT,
    "mosquitto_sub -t 'skyless/v1/+/tag/+/fix'": MQTT,
    "export SKYLESS_MQTT_PASSWORD=choose-one": BROKER + "test_wrong_options_are_reported_with_what_would_be_right",
    "skyless broker --listen 0.0.0.0 --user hall": (
        BROKER + "test_wrong_options_are_reported_with_what_would_be_right"
    ),
    "skyless dashboard --listen 0.0.0.0:8080 --mqtt mqtt://hall@127.0.0.1": (
        "tests/page/test_dashboard_end_to_end.py::test_other_machines_need_the_token_that_is_printed"
    ),
    "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 3650"
    " -keyout key.pem -out certificate.pem -subj /CN=hall.local -addext subjectAltName=DNS:hall.local"
    " -addext keyUsage=critical,digitalSignature,keyCertSign": (
        ROLES + "test_a_broker_with_another_certificate_gets_no_password"
    ),
    "skyless broker access passwords --mqtt mqtts://hall.local": (
        "tests/run/test_broker_access.py::test_the_files_are_private_complete_and_never_replaced"
    ),
    "skyless broker --listen 0.0.0.0:8883 --access passwords --certificate certificate.pem --key key.pem": (
        "tests/run/test_broker_access.py::test_roles_open_the_broker_to_other_machines"
    ),
    "skyless broker --listen 0.0.0.0:8883 --access passwords --strangers-read --certificate certificate.pem"
    " --key key.pem": "tests/run/test_broker_access.py::test_each_role_receives_exactly_what_the_table_says",
    "export SKYLESS_MQTT_CA=certificate.pem": ROLES + "test_the_programs_of_a_site_may_do_all_that_they_do",
    "set -a; . passwords/tags.env; set +a": ROLES + "test_a_shell_reads_the_file_of_a_role",
    "skyless tag tag1": ROLES + "test_the_programs_of_a_site_may_do_all_that_they_do",
    "skyless plan big_hall.toml --plot big_hall.png --html big_hall.html --target 5": PLAN + "test_all_files_at_once",
    "skyless plan big_hall.toml --optimise 8 --heights 0.5,3.5 --out better.toml": (
        PLAN + "test_an_optimised_site_is_a_site"
    ),
    "skyless plan big_hall.toml --verify 20": PLAN + "test_verification_tells_its_points",
    "skyless replay capture.yaml --anchors anchors.csv": REPLAY + "test_every_format_gives_fixes_at_the_truth",
    "skyless replay flight_tdoa.csv.gz --anchors anchors.csv --truth flight_pose.csv.gz"
    " --lever-arm=-0.012,0.001,0.091 --plot flight.png": (
        "tests/research/test_replay_acceptance.py::test_the_lever_arm_brings_the_truth_to_the_antenna"
    ),
    "skyless benchmark recordings --out compared": BENCHMARK + "test_figures_are_those_of_the_fixes",
    "skyless benchmark recordings --quick --out quick": BENCHMARK + "test_what_exists_is_not_computed_again",
    "skyless benchmark recordings --estimator own_estimator.py:Filter --out compared": (
        BENCHMARK + "test_figures_are_those_of_the_fixes"
    ),
    "skyless replay flight_tdoa.csv.gz --anchors anchors.csv --truth flight_pose.csv.gz"
    " --estimator own_estimator.py:Filter": "tests/cli/test_examples.py::test_own_estimator_on_a_recording",
    "skyless simulate --scenario room --estimator own_estimator.py:Filter": (
        "tests/cli/test_examples.py::test_own_estimator"
    ),
    "skyless survey --mqtt mqtt://127.0.0.1 --site site.toml --duration 30 --anchor-height 2.6 --anchor-height 3=0.5"
    " --axes 1,4,6 --out surveyed.toml": (
        "tests/run/test_live_survey.py::test_a_site_without_positions_is_surveyed_and_serves_tags"
    ),
    "skyless survey --recording walk.mcap --site hall.toml --walk tag1 --out walked.toml": (
        "tests/research/test_walk_of.py::test_the_command_uses_the_walk"
    ),
    "skyless calibrate walk.mcap --at 3,4 --site hall.toml --out calibrated.toml": (
        "tests/cli/test_calibrate_command.py::test_the_delays_of_a_site_are_found_and_written_back"
    ),
    "skyless study room --conditions nlos --quick --plot nlos.png": (
        "tests/research/test_study_command.py::test_a_study_tells_its_rows_and_writes_its_files"
    ),
    "skyless study room --plot room.png": (
        "tests/research/test_study_command.py::test_the_study_of_the_room_tells_levels_and_what_is_missed"
    ),
    "skyless paper --out report": "tests/research/test_paper_report.py::test_verdicts_are_those_of_the_long_report",
    "skyless paper --out quick-report --quick": (
        "tests/research/test_paper_report.py::test_every_picture_is_there_twice_and_nothing_is_left_over"
    ),
    "mosquitto_sub -v -t 'skyless/v1/+/alarm/+/+/state'": (
        "tests/run/test_alarms_through_broker.py::test_from_a_fix_to_a_webhook_and_on_to_the_next_dashboard"
    ),
    "skyless bridge 'webhook+https://alarms.example.org/skyless?secret_file=webhook.secret'": (
        "tests/bridges/test_alarm_targets.py::test_what_becomes_of_an_alarm_is_posted_in_order_and_signed"
    ),
    "skyless bridge 'smtp://site@mail.example.org:587?starttls&to=ada@example.org,bob@example.org"
    "&from=site@example.org&password_file=mail.password'": (
        "tests/bridges/test_alarm_targets.py::test_a_mail_when_an_alarm_is_raised_and_when_it_has_ended"
    ),
    "python examples/own_radio.py": "tests/cli/test_examples.py::test_own_radio",
}
"""Lines that run until Ctrl-C, take long or need what is not here, and the tests that run such a command."""

NEVER_RUN = (
    "docker ",
    "ANCHOR_1=",
    "UV_PROJECT_ENVIRONMENT=",
    "python3 -m venv /opt",
    "mkdir ",
    "cp packaging",
    "echo RADIO=",
    "systemctl ",
    "install -d ",
    "runuser ",
    "SURVEY_MQTT=",
)
"""Lines that need a Raspberry Pi, systemd or Docker begin like this; the pages that show them say so."""

UNTIL_CTRL_C = {"anchor", "board", "bridge", "broker", "dashboard", "demo", "ether", "record", "tag"}


def arguments_of(command):
    """What follows the program's name; None where it is another program."""
    words = shlex.split(command)
    return words[1:] if words[0] in {"skyless", "scripts/run"} else None


def name_of(page):
    return str(page.relative_to(ROOT))


pages = pytest.mark.parametrize("page", PAGES, ids=name_of)


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """A recording as ``skyless record`` writes it, of a tag named tag1."""
    path = tmp_path_factory.mktemp("walk") / "walk.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(live_site.PLACES, "tag1", (3.0, 4.0, 0.0))
        live_site.record(path, live_site.messages(3.0, tags=("tag1",)))
    return path.read_bytes()


@pages
@pytest.mark.statistical
def test_the_commands_of_a_page_run(page, walk, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("walk.mcap").write_bytes(walk)
    if not any(command.startswith("skyless site new hall.toml") for command in commands(page)):
        assert main(["site", "new", "hall.toml"]) == 0
    for command in commands(page):
        arguments = arguments_of(command)
        if command in ELSEWHERE:
            if arguments and arguments != ["--version"]:
                program().parse_args(arguments, print_error=False, exit_on_error=False)
            continue
        if command.startswith(NEVER_RUN):
            assert re.search(r"has never been built|Nothing of this page has run", " ".join(page.read_text().split()))
            continue
        assert arguments, f"{name_of(page)}: name the test that runs {command!r} in ELSEWHERE"
        assert arguments[0] not in UNTIL_CTRL_C, f"{name_of(page)}: name the test that runs {command!r} in ELSEWHERE"
        assert main(arguments_of(SHORTER.get(command, command))) == 0, f"{command}\n{capsys.readouterr().err}"
    if page != README:
        for example in blocks(page, "python"):
            exec(compile(example, name_of(page), "exec"), {})


@pytest.mark.statistical
def test_what_the_first_tutorial_says_of_its_simulations_is_so(tmp_path, monkeypatch, capsys):
    """Errors as large as the fixes state, nearly all within their levels, and larger with faults."""
    page = ROOT / "docs" / "tutorials" / "first_site.md"
    text = " ".join(page.read_text(encoding="utf-8").split())
    assert "It should be about as large" in text
    assert "The error grows, and the predicted σ grows with it." in text
    monkeypatch.chdir(tmp_path)
    told = []
    for command in commands(page):
        if command.startswith(("skyless site new hall", "skyless simulate ")):
            assert main([*arguments_of(command), *(["--json"] if "simulate" in command else [])]) == 0
            told.append(capsys.readouterr().out)
    plain, broken = map(json.loads, told[-2:])
    for one in (plain, broken):
        assert 2 / 3 < one["rmse_m"] / one["sigma_m"] < 3 / 2
        assert one["levels"]["misleading"] <= 0.001 * one["fixes"]
        assert one["errors_drawn"]["ranges"]["constant_m"] > 0.0
    assert broken["rmse_m"] > plain["rmse_m"]
    assert broken["sigma_m"] > plain["sigma_m"]


def test_every_entry_is_of_a_line_and_names_a_test():
    shown = {command for page in PAGES for command in commands(page)}
    assert not (SHORTER.keys() | ELSEWHERE.keys()) - shown
    for test in set(ELSEWHERE.values()):
        file, _, name = test.partition("::")
        if file.startswith("tests/"):
            tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
            assert not name or name in {
                node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            }, test


@pages
def test_no_command_stands_outside_a_shell_block(page):
    text = page.read_text(encoding="utf-8")
    assert set(re.findall(r"^```(\w*)\n(?:.*?)^```", text, re.DOTALL | re.MULTILINE)) <= {
        "sh",
        "python",
        "text",
        "ini",
        "dockerfile",
    }
    prose = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    assert not re.findall(r"^ {4}(?:skyless|scripts|python|sudo|docker) .*", prose, re.MULTILINE)


@pytest.mark.site
def test_the_example_runs(capsys):
    (example,) = blocks(README, "python")
    exec(compile(example, str(README), "exec"), {})
    x, y, z = map(float, re.search(r"\[ *(\S+) +(\S+) +(\S+) *\]", capsys.readouterr().out).groups())
    assert abs(x - 3.0) < 0.15
    assert abs(y - 4.0) < 0.15
    assert z == 0.0


def test_its_picture_has_the_tabs_of_the_page():
    """Those that a site without a master has; ``docs/pictures/page.py`` has written what it saw into the picture."""
    browser = ROOT / "src" / "skyless" / "page" / "browser"
    code = (browser / "tabs.js").read_text("utf-8")
    folders = dict(re.findall(r'import \* as (\w+) from "(\./\w+/\w+\.js)"', code))
    names = re.findall(r"\w+", re.search(r"const GROUPS = (.*?);", code, re.DOTALL)[1])
    texts = {name: (browser / folders[name]).read_text("utf-8") for name in names}
    titles = [re.search(r'export const title = "(.+)"', text)[1] for text in texts.values() if "isIdle" not in text]
    for theme in ("light", "dark"):
        with Image.open(ROOT / "docs" / "pictures" / f"page_{theme}.webp") as picture:
            assert picture.getexif()[0x010E] == ", ".join(titles)


def test_its_links_lead_somewhere():
    text = README.read_text(encoding="utf-8")
    for link in [*re.findall(r"\]\(([^)#]+)", text), *re.findall(r"(?:src|srcset)=\"([^\"]+)\"", text)]:
        assert (README.parent / link).exists(), link


def test_how_often_levels_were_exceeded_is_the_same_everywhere():
    """README rounds what docs/recordings.md has of all fixes with a level, from the first one on."""
    recordings = (ROOT / "docs" / "recordings.md").read_text()
    row = re.search(r"exceeded horizontally, vertically \| (\d+), (\d+) of ([\d,]+)", recordings)
    across, up, fixes = (int(number.replace(",", "")) for number in row.groups())
    once = int(re.search(r"exceeded in 1 of ([\d,]+) fixes", README.read_text())[1].replace(",", ""))
    assert once == pytest.approx(fixes / (across + up), rel=0.05)
