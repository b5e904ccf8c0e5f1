"""Run the command line; the first two arguments are a signal and the number of written rows before it is sent."""

import os
import signal
import sys

from flexneedle.lab.study.journal import StudyJournal


def main():
    """Send the signal after this number of rows: SIGINT to all processes, as a terminal does, others to this one."""
    from flexneedle.cli.main import main as flexneedle

    number, after = signal.Signals[sys.argv[1]], int(sys.argv[2])
    add = StudyJournal.add

    def add_and_stop(journal, rows):
        add(journal, rows)
        if len(journal.rows) == after:
            os.kill(0 if number == signal.SIGINT else os.getpid(), number)

    StudyJournal.add = add_and_stop
    return flexneedle(sys.argv[3:])


if __name__ == "__main__":
    sys.exit(main())
