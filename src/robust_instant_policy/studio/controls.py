"""Only one browser controls the page; the others watch."""

import time
from collections.abc import Awaitable, Callable
from typing import Any

import viser

Action = Callable[[Any], None]
Callback = Callable[[Any], Awaitable[None]]
NOTE_S = 4.0


class Controls:
    """Accepts the events of one browser only: the first one, until it leaves or another one takes the controls with a
    button."""

    def __init__(self, server: viser.ViserServer):
        self._server = server
        self._holder: int | None = None
        self._buttons: dict[int, viser.GuiButtonHandle] = {}
        self._told: dict[int, float] = {}  # when an onlooker was told that it is one
        server.on_client_connect(self._come)
        server.on_client_disconnect(self._leave)

    def held(self, action: Action) -> Callback:
        """A callback that calls ``action(event)`` for the holder's events only."""

        async def callback(event: Any) -> None:
            if event.client_id is None or event.client_id == self._holder:
                action(event)
            elif event.client is not None and time.monotonic() - self._told.get(event.client_id, 0.0) > NOTE_S:
                self._told[event.client_id] = time.monotonic()
                event.client.add_notification(
                    "You are watching",
                    "Another browser holds the controls. Press “Take the controls” to have them.",
                    auto_close_seconds=NOTE_S,
                    color="yellow",
                )

        return callback

    def button(self, gui: viser.GuiApi, label: str, action: Action, **look: Any) -> viser.GuiButtonHandle:
        """A button that calls ``action(event)`` when the holder presses it."""
        handle = gui.add_button(label, **look)
        handle.on_click(self.held(action))
        return handle

    def input(self, handle: Any, action: Action) -> None:
        """Call ``action(event)`` when the holder changes the input ``handle``; what an onlooker changes is undone."""
        accepted = handle.value

        def accept(event: Any) -> None:
            nonlocal accepted
            accepted = handle.value
            action(event)

        pass_on = self.held(accept)

        async def callback(event: Any) -> None:
            nonlocal accepted
            if event.client_id is None:  # set by the program
                accepted = handle.value
                return
            await pass_on(event)
            if handle.value != accepted:
                handle.value = accepted

        handle.on_update(callback)

    async def _come(self, client: viser.ClientHandle) -> None:
        if self._holder is None:
            self._holder = client.client_id
        else:
            self._offer(client)

    async def _leave(self, client: viser.ClientHandle) -> None:
        self._buttons.pop(client.client_id, None)
        self._told.pop(client.client_id, None)
        if client.client_id == self._holder:
            others = self._server.get_clients()
            self._give(next(iter(others), None))

    def _offer(self, client: viser.ClientHandle) -> None:
        """Give ``client`` the button that takes the controls."""
        button = client.gui.add_button("Take the controls (you are watching)", color="yellow", order=-1.0)
        self._buttons[client.client_id] = button

        async def take(_: Any) -> None:
            before = self._server.get_clients().get(-1 if self._holder is None else self._holder)
            self._give(client.client_id)
            if before is not None:
                self._offer(before)

        button.on_click(take)

    def _give(self, client: int | None) -> None:
        self._holder = client
        button = None if client is None else self._buttons.pop(client, None)
        if button is not None:
            button.remove()
