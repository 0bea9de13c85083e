"""Every test process lives in folders of its own: locks, sockets, state and data of other runs are out of reach."""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
import threading
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before numpy is loaded
_home = tempfile.mkdtemp(prefix="frictid-tests-")
for _name in ("FRICTID_RUNTIME_DIR", "XDG_STATE_HOME", "XDG_DATA_HOME"):
    os.environ[_name] = f"{_home}/{_name.lower()}"
    Path(os.environ[_name]).mkdir()

# In the background of a script, or behind ``nohup``, signals are ignored, and so they are in the runs that tests stop.
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

# How long a busy computer takes says nothing of what is tested.
settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")
settings.register_profile(
    "fast", settings.get_profile("patient"), max_examples=20
)  # the developer's loop; the whole check draws as many as tests say

# What a run says that the supervisor or a drive has ended. Where this computer is late, they are right to.
STALLED = (
    r"error:(\x1b\[0m)? joint .*(no report|no heartbeat|following error|reported velocity|drive reports error)"
    r"|\"aborted\""
)

SAMPLED = {  # function: the parameters that the whole check takes; ``--long`` takes them all
    "test_calibrated_behind_anothers_canopen": {"copley"},
    "test_tshark_finds_no_malformed_frame": {"copley", "zeroerr"},
    "test_a_unit_is_found_and_its_interval_covers_it": {
        *("0-copley", "6-nanotec", "10-damiao", "13-cybergear", "16-feetech-scs", "17-dynamixel"),
    },
    "test_checked_calibrated_and_compensated": {"copley", "eyou", "synapticon"},
    "test_every_refusal_of_a_strict_drive_is_foreseen": {"elmo", "epos4", "nanotec", "synapticon"},
    "test_compensation_follows_better_than_none": {"damiao", "robstride"},
    "test_a_servo_that_no_word_reaches_is_judged_by_where_it_is": {
        *("feetech calibrate-hold-send value", "feetech compensate-track mop-servo silent"),
    },
    "test_a_healthy_servo_of_two_speeds_is_within_its_interval": {"feetech calibrate"},
    "test_every_effect_is_named": {
        *("joint_elasticity", "stribeck", "torque_delay", "torque_ripple"),
    },
    "test_play_whose_phase_is_lost_along_the_motion_is_sought_in_closed_loop": {"alone"},
    "test_a_late_drive_is_late_with_what_wrong_gains_ask_for": {"electrical_lag"},
    "test_no_gap_is_reported_that_is_larger_than_the_logs_contain": {"healthy", "joint_elasticity"},
    "test_traces_that_are_real_but_drown_in_noise_are_no_cause": {"1"},
    "test_nine_of_ten_knots_are_covered_and_the_intervals_are_not_useless": {
        *("indices0-aligned", "indices1-function-a", "indices1-least-squares"),
    },
    "test_a_rigid_joint_has_no_link_in_short_programmes_or_at_250_hz": {"quick-0.004", "standard-0.001"},
    "test_six_joints_streaming_at_921600_are_within_the_bar": {"1", "5"},
    "test_a_job_whose_port_comes_back_is_fetched_to_its_end": {"0.4"},
    "test_a_fault_in_batch_keeps_the_recording_and_resumes": {
        *("hold@300-4-pressed hold", "unplug@1600-3-port is gone"),
    },
    "test_an_averaging_filter_of_150_ms_ends_in_the_gates_refusal": {"batch"},
    "test_twice_stops_quickly": {"2-15"},
    "test_every_family_is_checked_calibrated_and_compensated": {"STS3215", "XL430-W250"},
    "test_the_commands_of_a_guide_run": {"connect-a-drive", "diagnose", "recalibrate", "replay", "robot-file"},
    "test_a_fault_leaves_nothing_moving_nothing_lost_and_no_wrong_curve": {
        *("calibrate-cycles-bus off", "calibrate-cycles-node reboots", "calibrate-move-position jumps a turn"),
        *("calibrate-cycles-torque times 1.5", "calibrate-rehearsal-drive faults", "calibrate-rehearsal-send os"),
    },
    "test_every_ending": {"within the policy", "drifted", "changed too much", "encoder lost", "power lost"},
    "test_faults_on_a_pseudo_terminal": {
        *("alarm@60:4107", "bad_crc@40", "hold@60", "lost_frame@50x2", "merge@0:0.01", "nak@2", "unplug@40"),
    },
    "test_page_draws_without_errors": {"calibration", "gap", "recalibration"},
    "test_the_docs_show_the_page_as_it_is": {"calibration-size0", "gap-size3", "arm-size4"},
    "test_the_contrast_holds_in_the_dark_too": {"gap"},
    "test_a_curve_concave_below_its_first_pair_is_no_stribeck_without_a_warning": {
        *("speeds0-torques0-closed loop", "speeds1-torques1-no controller"),
    },
    "test_what_wins_within_its_logs_and_loses_on_others_is_not_reported": {
        *("_bias_of_one_half-closed loop", "_flipped_ripple-no controller"),
    },
    "test_a_cause_that_steps_hide_is_found_in_the_loops_torque": {"gravity_error-error_share-0.1"},
    "test_a_stop_on_request_stays_within_the_planned_travel_and_in_time": {"40", "118", "170", "290"},
    "test_the_exported_joint_moves_as_in_our_own_simulator": {"backlash", "stribeck", "torque_ripple", "velocity_lag"},
    "test_function_a_reaches_its_level_on_other_friction": {"0-0", "1-3", "3-4", "5-2"},
}
LONG = {  # functions that ``--long`` alone runs: what they show is shown by others in a smaller way
    "test_a_killed_worker_of_a_cluster_costs_its_own_task_alone",
    "test_an_effect_is_recorded_named_and_closed",
    "test_equal_seeds_seal_equal_truth_whatever_the_processes",
    "test_behind_another_authors_canopen_on_that_link",
    "test_can_fd_carries_them_faster_and_its_log_replays",
    "test_can_fd_changes_no_figure",
    "test_a_round_of_the_soak_keeps_nothing",
    "test_the_loop_is_timed_beside_stock_canopen_and_beside_an_empty_one",
    "test_the_table_does_what_a_can_run_with_the_same_delay_does_within_three_points",
    "test_an_error_of_the_belief_that_makes_four_floors_in_the_loop_is_named_small_as_it_is_along_the_motion",
    "test_calibrated_behind_anothers_canopen_and_a_gateway_on_tcp",
    "test_a_lag_of_the_drive_is_told_behind_a_velocity_that_lags_by_another_filter",
    "test_play_is_found_behind_a_coarse_encoder",
    "test_the_arm_is_late_whichever_motions_are_judged",
    "test_what_was_left_out_is_told_with_its_reason",
    "test_friction_is_found_over_it",
    "test_on_the_wall_clock_it_reaches_the_same",
    "test_recorded_again_a_joint_has_other_noise_and_lacks_what_is_left_out",
}


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--long", action="store_true", help="run every proof, also those that the whole check samples")


def pytest_unconfigure(config: pytest.Config) -> None:
    shutil.rmtree(_home, ignore_errors=True)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """What runs on the wall clock may stall. Without ``--long``, many proofs of one kind are a sample of them."""
    for item in items:
        if item.get_closest_marker("wall_clock"):
            item.add_marker(pytest.mark.flaky(reruns=4, only_rerun=STALLED))
            item.add_marker(pytest.mark.timeout(900))  # of all attempts together
    left_out = [] if config.getoption("--long") else [item for item in items if _is_long(item)]
    if items and len(left_out) == len(items):
        raise pytest.UsageError("these tests are no part of the whole check's sample: add --long")
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]


def _is_long(item: pytest.Item) -> bool:
    name, _, parameters = item.name.partition("[")
    sample = SAMPLED.get(name)
    return name in LONG or (sample is not None and parameters.removesuffix("]") not in sample)
