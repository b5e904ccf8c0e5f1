"""A worker of the page that runs the script of its argument; `channel` is its end of the channel."""

import sys

from flexneedle.lab.process import open_channel

if __name__ == "__main__":
    exec(sys.argv[2], {"channel": open_channel(int(sys.argv[1]))})
