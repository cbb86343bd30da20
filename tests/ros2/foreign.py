"""A ROS program that knows nothing of dxlrun: each line of its input, [verb, arguments, ...], is answered.

It is run by a Python of a ROS environment, and needs rclpy and the packages of the messages that it is given.
Lines and answers are JSON.
"""

import contextlib
import importlib
import itertools
import json
import re
import sys
import threading
import time

import rclpy
from rclpy.action import ActionClient
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

DEADLINE_S = 40.0


def type_of(name):
    """Return a class of messages, services or actions by its ROS name."""
    package, kind, one = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), one)


def filled(message, fields):
    """Put fields into a message."""
    for name, value in fields.items():
        if isinstance(value, dict):
            filled(getattr(message, name), value)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            package, one = re.search(r"(\w+)/(\w+)", message.get_fields_and_field_types()[name]).groups()
            setattr(message, name, [filled(type_of(f"{package}/msg/{one}")(), each) for each in value])
        else:
            setattr(message, name, value)
    return message


def plain(value):
    """Return a message as JSON has it."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if hasattr(value, "tolist"):
        return value.tolist()
    return value if isinstance(value, str | int | float) else [plain(each) for each in value]


def until(condition, awaited):
    """Return what a condition has found as soon as that is true."""
    end = time.monotonic() + DEADLINE_S
    while not (found := condition()):
        if time.monotonic() > end:
            raise TimeoutError(awaited)
        time.sleep(0.005)
    return found


class Foreign(Node):
    """What it can do; the public methods are its verbs."""

    def __init__(self, name):
        super().__init__(name)
        self._heard, self._made = {}, {}

    def _once(self, make, kind, name):
        if (kind, name) not in self._made:
            self._made[kind, name] = make(type_of(kind), name)
        return self._made[kind, name]

    def _ended(self, future, awaited):
        until(future.done, awaited)
        return future.result()

    def hear(self, key, topic, kind, reliable=True, latched=False):
        """Subscribe to a topic; `key` is the name of what comes by this subscription."""
        qos = QoSProfile(
            depth=2000,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        heard = self._heard[key] = []
        self.create_subscription(type_of(kind), topic, lambda one: heard.append((time.time_ns(), one)), qos)

    def heard(self, key, least=1, since=0):
        """Return the messages from number `since` on, when there are so many, and when they came."""
        heard = self._heard[key]
        until(lambda: len(heard) >= since + least, f"{least} of {key}")
        found = heard[since:]
        return {"messages": [plain(one) for _, one in found], "times_ns": [at for at, _ in found]}

    def count(self, key):
        """Return how many messages came."""
        return len(self._heard[key])

    def graph(self):
        """Return the types of all topics and services by name."""
        both = *self.get_topic_names_and_types(), *self.get_service_names_and_types()
        return {name: types[0] for name, types in both}

    def qos(self, topic):
        """Return of each publisher of a topic whether it is reliable, and transient local."""
        until(lambda: self.count_publishers(topic), f"publisher of {topic}")
        return [
            [
                one.qos_profile.reliability == ReliabilityPolicy.RELIABLE,
                one.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL,
            ]
            for one in self.get_publishers_info_by_topic(topic)
        ]

    def say(self, topic, kind, fields):
        """Publish a message, as soon as there is a subscriber."""
        publisher = self._once(lambda made, name: self.create_publisher(made, name, 10), kind, topic)
        until(publisher.get_subscription_count, f"subscriber of {topic}")
        publisher.publish(filled(type_of(kind)(), fields))

    def stream(self, topic, kind, rows, period_s):
        """Publish messages in turn, to the end of this program."""

        def repeat():
            for row in itertools.cycle(rows):
                self.say(topic, kind, row)
                time.sleep(period_s)

        threading.Thread(target=repeat, daemon=True).start()

    def call(self, service, kind, fields):
        client = self._once(self.create_client, kind, service)
        until(client.service_is_ready, f"service {service}")
        return plain(self._ended(client.call_async(filled(type_of(kind).Request(), fields)), service))

    def act(self, action, kind, goal, cancel_after=None):
        """Send a goal, cancel it after so many messages of feedback, and return its end."""
        client = self._once(lambda made, name: ActionClient(self, made, name), kind, action)
        until(client.server_is_ready, f"action {action}")
        feedback = []
        sent = client.send_goal_async(
            filled(type_of(kind).Goal(), goal), lambda one: feedback.append(plain(one.feedback))
        )
        handle = self._ended(sent, f"an answer of {action}")
        if not handle.accepted:
            return {"accepted": False}
        result = handle.get_result_async()
        if cancel_after is not None:
            until(lambda: len(feedback) >= cancel_after or result.done(), f"feedback of {action}")
            answer = self._ended(handle.cancel_goal_async(), f"cancellation of {action}")
            assert answer.goals_canceling or result.done(), answer
        end = self._ended(result, f"the result of {action}")
        return {"accepted": True, "status": end.status, "feedback": feedback, **plain(end.result)}

    def serve(self):
        """Do what the lines say, to the end of the input."""
        for line in sys.stdin:
            verb, *words = json.loads(line)
            try:
                answer = ["ok", getattr(self, verb)(*words)]
            except Exception as error:  # the other side judges
                answer = ["failed", f"{verb} {words[0] if words else ''}: {error!r}"]
            sys.stdout.write(json.dumps(answer) + "\n")
            sys.stdout.flush()


def main():
    """Serve one input."""
    rclpy.init()
    node = Foreign(sys.argv[1])

    def spin():
        with contextlib.suppress(ExternalShutdownException):
            rclpy.spin(node)

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    node.serve()
    rclpy.shutdown()
    thread.join()


if __name__ == "__main__":
    main()
