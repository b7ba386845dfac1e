"""What a browser may change of the page: values of its controls, and nothing else."""

from collections.abc import Callable
from typing import Any


def take_values_only(server: Any, refuse: Callable[[str], None]) -> None:
    """Have a viser server take values of controls only, and tell what else a browser sends.

    viser itself lets a browser change every property of a control, as whether it is shown.

    Args:
        server: The viser server.
        refuse: Called with what was refused.
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
