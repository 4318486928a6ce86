"""Following updates: subscription connections, local copies, and the subscribers that users hold."""
