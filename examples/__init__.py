"""Short programs that show REEM at work; run each from the top folder with `python -m examples.NAME`."""
