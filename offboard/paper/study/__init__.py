"""The tables and figures of the paper, computed again and put on one page."""
