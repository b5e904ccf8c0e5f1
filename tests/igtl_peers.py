"""Peers of OpenIGTLink in the process of a test, whose messages pyigtl packs and reads: a Plus server, and a client."""

import socket
import threading
import time
from contextlib import contextmanager

import numpy as np
import pyigtl

from emulated import DEADLINE_S, until

DEVICE = "NeedleToTracker"


def pose(x, y=0.0, z=0.0, turn=None):
    """The matrix (4, 4) of a sensor at a position (mm); turn: its rotation (3, 3)."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.eye(3) if turn is None else turn
    matrix[:3, 3] = x, y, z
    return matrix


def transform(matrix, name=DEVICE, stamp=None):
    """The bytes of a TRANSFORM."""
    at = time.time() if stamp is None else stamp
    return pyigtl.TransformMessage(matrix, timestamp=at, device_name=name).pack()


class PlusServer:
    """A server that sends `messages()` to its clients at a rate; port 0: any free port."""

    def __init__(self, messages, rate_hz=50.0, port=0):
        self.messages, self._period = messages, 1.0 / rate_hz
        self._server = socket.create_server(("127.0.0.1", port))
        self.port = self._server.getsockname()[1]
        self._clients, self._ended = [], threading.Event()
        self._threads = [threading.Thread(target=one, daemon=True) for one in (self._accept, self._send)]
        for thread in self._threads:
            thread.start()

    def _accept(self):
        while not self._ended.is_set():
            try:
                self._clients.append(self._server.accept()[0])
            except OSError:
                return

    def _send(self):
        while not self._ended.wait(self._period):
            for client in list(self._clients):
                try:
                    client.sendall(b"".join(self.messages()))
                except OSError:
                    self._clients.remove(client)
                    client.close()

    def close(self):
        self._ended.set()
        self._server.shutdown(socket.SHUT_RDWR)  # ends the thread that accepts
        self._server.close()
        for thread in self._threads:
            thread.join()
        for client in self._clients:
            client.close()

    def __enter__(self):
        return self

    def __exit__(self, *_exception):
        self.close()


class Peer:
    """A client of pyigtl, which reads all our types but POLYDATA, STATUS and TRAJ. Use it by `connected`."""

    def __init__(self, port):
        self._client = pyigtl.OpenIGTLinkClient("127.0.0.1", port)
        self.messages = []

    def take(self):
        """Take the newest message of each device that has arrived; return all until now."""
        self.messages += self._client.get_latest_messages()
        return self.messages

    def last(self, name):
        """The last message of a device, None without one."""
        return next((one for one in reversed(self.take()) if one.device_name == name), None)

    def send(self, message):
        self._client.send_message(message, wait=False)

    def send_text(self, text):
        self.send(pyigtl.StringMessage(text, device_name="Text"))

    def send_stop(self):
        self.send(pyigtl.StringMessage("STOP", device_name="Command"))

    def send_points(self, **points):
        """Send points by name (mm)."""
        self.send(pyigtl.PointMessage(list(points.values()), names=list(points), device_name="Markups"))

    def send_registration(self, matrix):
        self.send(pyigtl.TransformMessage(matrix, device_name="ImageToNeedle"))

    def stop(self):
        self._client.stop()


@contextmanager
def connected(port, seconds=DEADLINE_S):
    """A peer that is connected to a port, once somebody listens there."""
    until(lambda: _listens(port), seconds)
    peer = Peer(port)
    try:
        until(peer._client.is_connected)
        yield peer
    finally:
        peer.stop()


def _listens(port):
    with socket.socket() as one:
        return one.connect_ex(("127.0.0.1", port)) == 0


def free_port():
    """A port on which nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as one:
        return one.getsockname()[1]
