"""What is built on REEM as any program would build on it: recordings, the browser, snapshots, the command line."""
