"""Where the cameras of a session stand: chains of pictures, clocks, worlds."""
