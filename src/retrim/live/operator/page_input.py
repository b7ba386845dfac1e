"""Filter the input to the page: a browser may change only the values of controls."""

from collections.abc import Callable
from typing import Any


def take_values_only(server: Any, refuse: Callable[[str], None]) -> None:
    """Restrict a viser server to changes of control values, and report any other browser input.

    By default viser lets a browser change every property of a control, such as its visibility.

    Args:
        server: The viser server.
        refuse: Function that is called with a description of each refused input.
    """
    from viser._messages import GuiUpdateMessage

    gui = server.gui
    connection, update = gui._websock_interface, gui._handle_gui_updates

    async def take(client: Any, message: Any) -> None:
        if not isinstance(message.updates, dict) or set(message.updates) != {"value"}:
            refuse("a browser may change values of controls only")
            return
        try:
            await update(client, message)
        except (AssertionError, AttributeError, TypeError, ValueError, OverflowError) as error:
            refuse(f"a value of another type ({type(error).__name__})")

    connection.unregister_handler(GuiUpdateMessage, update)
    connection.register_handler(GuiUpdateMessage, take)
