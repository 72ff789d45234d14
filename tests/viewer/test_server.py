"""A browser that leaves takes everything with it, whenever it leaves."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra `viewer` is not installed")

from p2gs_jax.viewer import server as module


class Server:
    """Keeps what it is told to call."""

    def __init__(self):
        self.gui = SimpleNamespace(configure_theme=lambda **options: None)
        self.scene = SimpleNamespace(set_up_direction=lambda up: None)
        self.initial_camera = SimpleNamespace()

    def on_client_connect(self, call):
        self.connect = call

    def on_client_disconnect(self, call):
        self.disconnect = call


@pytest.fixture
def served(monkeypatch):
    """Return a server, its sessions, and the ids of those that were made and stopped."""
    found = SimpleNamespace(server=Server(), sessions={}, made=[], stopped=[], on_made=None)

    class Session:
        def __init__(self, client, viewed):
            self.client = client
            found.made.append(client.client_id)
            if found.on_made is not None:
                found.on_made(client)

        def stop(self):
            found.stopped.append(self.client.client_id)

    monkeypatch.setattr(module, "BrowserSession", Session)
    pose = SimpleNamespace(position=np.zeros(3), look_at=np.ones(3), fov=1.0)
    viewed = SimpleNamespace(
        space=SimpleNamespace(up="+z"), first_view=0, pose=lambda view, aspect: pose
    )
    module._set_up_server(found.server, viewed, found.sessions)
    return found


def test_a_browser_that_leaves_is_stopped_once(served):
    clients = [SimpleNamespace(client_id=k) for k in range(3)]
    for client in clients:
        served.server.connect(client)
    assert sorted(served.sessions) == [0, 1, 2]
    served.server.disconnect(clients[1])
    assert sorted(served.sessions) == [0, 2]
    assert served.stopped == [1]


def test_a_browser_that_leaves_while_its_session_is_made_leaves_nothing(served):
    served.on_made = served.server.disconnect
    for number in (5, 6):
        served.server.connect(SimpleNamespace(client_id=number))
    assert served.made == served.stopped == [5, 6]
    assert served.sessions == {}
