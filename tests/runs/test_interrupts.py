"""Signals: a flag while there is something to save, an exception before."""

import os
import signal

import pytest

from playground.runs.interrupts import Interrupted, Interrupts, exit_code


def test_before_there_is_anything_to_save_a_signal_ends_the_run() -> None:
  with Interrupts(), pytest.raises(Interrupted, match="SIGTERM"):
    os.kill(os.getpid(), signal.SIGTERM)


def test_while_saving_the_first_is_a_flag_and_the_second_ends_the_run() -> None:
  with Interrupts() as interrupts:
    interrupts.start_saving()
    os.kill(os.getpid(), signal.SIGINT)
    assert interrupts.signum == signal.SIGINT
    with pytest.raises(Interrupted, match="SIGINT"):
      os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_signal_whose_exception_was_swallowed_still_ends_the_run() -> None:
  class Swallows:
    def __del__(self) -> None:
      os.kill(os.getpid(), signal.SIGTERM)

  with Interrupts() as interrupts:
    del (_ := [Swallows()])[0]
    with pytest.raises(Interrupted, match="SIGTERM"):
      interrupts.start_saving()


def test_the_old_handlers_come_back() -> None:
  before = signal.getsignal(signal.SIGTERM)
  with Interrupts():
    assert signal.getsignal(signal.SIGTERM) is not before
  assert signal.getsignal(signal.SIGTERM) is before
  assert [exit_code(s) for s in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)] == [130, 143, 129]


def test_a_hang_up_saves_unless_it_is_ignored() -> None:
  before = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # these tests may run under `nohup`
  try:
    with Interrupts() as interrupts:
      interrupts.start_saving()
      os.kill(os.getpid(), signal.SIGHUP)
      assert interrupts.signum == signal.SIGHUP
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as `nohup` does
    with Interrupts():
      os.kill(os.getpid(), signal.SIGHUP)
  finally:
    signal.signal(signal.SIGHUP, before)
