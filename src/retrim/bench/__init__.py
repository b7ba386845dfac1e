"""How long each piece of work takes on this machine, and how much memory."""
