"""The command with a count of its control periods, for a process of its own."""

from flexneedle.cli import insert, main


def counted(arguments, made):
    """Run the command; made: counts its periods, each once it has ended and is recorded."""

    def period(*_):
        made.value += 1

    insert._InsertProgress._show_period = period  # in this process alone
    main.main(arguments)
