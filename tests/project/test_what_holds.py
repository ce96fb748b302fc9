"""What an adversary has tried and what held, in one place: the tests that say so still, by folder."""

import ast
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
HOLDS = {
    "bridges": (
        "test_a_name_cannot_add_headers",
        "test_pages_of_other_sites_are_refused",
    ),
    "core": (
        "test_no_forged_frame_moves_a_verified_fix_or_an_anchor",
        "test_a_tag_on_a_hostile_channel",
        "test_an_anchor_on_a_hostile_channel",
    ),
    "firmware": ("test_random_bytes_any_chip_and_damaged_beacons_stop_nothing",),
    "native": ("test_sanitizers_find_nothing_and_every_fix_is_a_number",),
    "page": (
        "test_requests_that_are_not_finished_make_room_for_a_reader",
        "test_beyond_the_limit_of_requests_in_work_a_client_is_told",
        "test_without_the_token_every_request_of_a_stranger_is_refused",
        "test_a_rebound_name_is_refused",
        "test_other_sites_pages_are_refused",
        "test_another_sites_image_or_link_gets_the_page_at_most",
        "test_files_outside_the_page_stay_there",
        "test_all_computers_together_open_a_limited_number_of_pages",
        "test_twenty_sites_are_shown_and_those_that_nobody_looks_at_are_let_go",
        "test_the_readers_token_reads_and_the_operators_does_all",
        "test_a_real_history_answers_and_a_question_that_takes_too_long_is_ended",
        "test_there_are_only_so_many",
    ),
    "research": ("test_made_up_captures",),
    "run": (
        "test_any_bytes_as_a_public_key_give_one_line",
        "test_damaged_bytes_are_refused_or_a_batch_and_raise_nothing_else",
        "test_fifty_kills_lose_no_acknowledged_batch_and_double_none",
        "test_a_disk_that_takes_nothing_is_said_and_forgiven",
        "test_sql_reads_the_history_and_nothing_else",
        "test_what_is_too_much_is_refused_with_what_would_do",
        "test_a_damaged_file_is_named_and_no_traceback",
        "test_every_fix_is_in_the_history_once_after_kills_and_cuts",
        "test_a_wrong_certificate_is_said_and_a_right_one_is_taken",
        "test_no_site_writes_as_another",
        "test_a_placement_far_from_the_site_file_moves_no_anchor_with_keys",
        "test_all_that_targets_need_comes_from_the_broker_and_nonsense_is_counted",
        "test_each_role_publishes_exactly_what_the_table_says",
        "test_each_role_receives_exactly_what_the_table_says",
        "test_the_files_are_private_complete_and_never_replaced",
        "test_a_full_disk_ends_the_recording_once_and_leaves_a_whole_file",
        "test_damaged_files_do_not_raise",
    ),
    "site": ("test_no_file_ends_in_anything_but_a_configuration_error",),
}


@pytest.mark.parametrize("room", HOLDS)
def test_the_tests_are_there(room):
    trees = [ast.parse(file.read_text(encoding="utf-8")) for file in (TESTS / room).rglob("test_*.py")]
    assert {*HOLDS[room]} <= {getattr(node, "name", "") for tree in trees for node in tree.body}
