"""Node `flexneedle_operator`: services `~/stop` and `~/arm` (std_srvs/srv/Trigger) of a flexneedle rig.

The rig itself has topics, which are the same for every DDS vendor. A service call publishes on its topic. It succeeds
when the rig, which reports its state at least once a second, then reports a state that shows the effect, and fails
after `answer_s`.
"""

import sys
import threading
import time

STOPPED = ("stopped", "fault")
"""Without idle, which may have been reported before the stop; an idle rig confirms a stop with "stopped"."""
ARMED = ("armed",)
UNDER_WAY = ("inserting", "holding")
"""States that also show the arming of an idle rig: "armed" is short, and the topic keeps one state."""
REPEAT_S = 0.05

DEFAULTS = {
    "stop_topic": "/flexneedle/stop",
    "arm_topic": "/flexneedle/arm",
    "state_topic": "/flexneedle/state",
    "answer_s": 2.0,
}


class States:
    """Reported states of the rig, for threads that wait for one."""

    def __init__(self):
        self._changed = threading.Condition()
        self._state = ""
        self._count = 0
        self._newest = {}

    def report(self, state):
        """Store a state that the rig reports."""
        with self._changed:
            self._state = state
            self._count += 1
            self._newest[state] = self._count
            self._changed.notify_all()

    @property
    def last(self):
        """The last state, "" before the first."""
        return self._state

    @property
    def count(self):
        """The number of reports."""
        return self._count

    def wait(self, wanted, since, seconds):
        """Return whether a state among `wanted` follows the first `since` reports within `seconds`.

        Another state may have been reported after it.
        """

        def is_reported():
            return any(self._newest.get(state, 0) > since for state in wanted)

        with self._changed:
            return self._changed.wait_for(is_reported, seconds)


def ask(publish, states, wanted, seconds, *, repeat):
    """Publish, repeatedly if `repeat`, until a state among `wanted` is reported; return whether it is in time.

    Earlier reports do not count: their rig may have ended.
    """
    deadline, since = time.monotonic() + seconds, states.count
    publish()
    while not states.wait(wanted, since, min(REPEAT_S, max(0.0, deadline - time.monotonic()))):
        if time.monotonic() >= deadline:
            return False
        if repeat:
            publish()
    return True


def answer(done, states, seconds):
    """Return the text of an answer."""
    state = f"the rig reports {states.last!r}" if states.last else "the rig has not reported a state"
    return state if done else f"not done within {seconds:g} s: {state}"


def carry_out(publish, states, wanted, seconds, *, repeat, missing):
    """Carry out a service; return whether it is done, and the text of its answer.

    missing: the reason why no rig can report its state, or "".
    """
    if missing:
        if repeat:  # stop a rig that reports no state, too
            publish()
        return False, missing
    shows = ARMED + UNDER_WAY if wanted is ARMED and states.last == "idle" else wanted
    done = ask(publish, states, shows, seconds, repeat=repeat)
    return done, answer(done, states, seconds)


def main(args=None):
    """Run the node until Ctrl-C. Returns 2 without ROS 2."""
    try:
        import rclpy
        from rclpy.callback_groups import ReentrantCallbackGroup
        from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from std_msgs.msg import Bool, String
        from std_srvs.srv import Trigger
    except ModuleNotFoundError as error:
        print(
            f"flexneedle_ros needs ROS 2 (no module {error.name}): source /opt/ros/DISTRIBUTION/setup.bash first",
            file=sys.stderr,
        )
        return 2

    rclpy.init(args=args)
    node = rclpy.create_node("flexneedle_operator")
    given = {name: node.declare_parameter(name, default).value for name, default in DEFAULTS.items()}
    states, group = States(), ReentrantCallbackGroup()
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(
        String,
        given["state_topic"],
        lambda message: states.report(message.data),
        latched,
        callback_group=group,
    )

    def serve(name, topic, wanted, *, repeat):
        publisher = node.create_publisher(Bool, topic, 1)

        def call(_request, response):
            reported = node.count_publishers(given["state_topic"]) > 0
            response.success, response.message = carry_out(
                lambda: publisher.publish(Bool(data=True)),
                states,
                wanted,
                given["answer_s"],
                repeat=repeat,
                missing="" if reported else f"no rig publishes {given['state_topic']}",
            )
            return response

        node.create_service(Trigger, f"~/{name}", call, callback_group=group)

    serve("stop", given["stop_topic"], STOPPED, repeat=True)
    serve("arm", given["arm_topic"], ARMED, repeat=False)
    executor = MultiThreadedExecutor()
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
