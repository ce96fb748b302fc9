"""What is frozen into the firmware, besides what the port brings."""

include("$(PORT_DIR)/modules/manifest.py")  # noqa: F821 - the build's words
freeze("$(BOARD_DIR)/../../../src/skyless/firmware", ("link.py", "dw1000.py", "board.py"), opt=3)  # noqa: F821
freeze("$(BOARD_DIR)/../..", ("nrf52.py", "main.py"), opt=3)  # noqa: F821
