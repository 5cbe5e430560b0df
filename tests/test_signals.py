"""Signals that ask to stop: which are heeded, and by whom."""

import signal
import subprocess
import sys

import pytest

from lgrasp.signals import spared, stop_signals


def test_ignored_signals_stay_ignored():
    """nohup ignores SIGHUP, a script's & ignores SIGINT."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert stop_signals() == [signal.SIGINT, signal.SIGTERM]
    finally:
        signal.signal(signal.SIGHUP, before)
    assert signal.SIGHUP in stop_signals()


@pytest.mark.parametrize("number", stop_signals())
def test_helpers_leave_signals_to_who_started_them(number):
    command = [sys.executable, "-c", "import sys; print(sys.stdin.readline(), end='')"]
    with spared():
        helper = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    helper.send_signal(number)
    assert helper.communicate("done\n", timeout=30)[0] == "done\n"
    assert helper.returncode == 0
    assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == set()
