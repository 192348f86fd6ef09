"""The paper: its laws as controllers, its plant, and the study of its tables and figures."""
