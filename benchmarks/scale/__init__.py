"""How far it goes: what an operation costs a server, and how many robots that makes: `python -m benchmarks.scale`."""
