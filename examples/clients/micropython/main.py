"""A client of REEM with the modules that MicroPython has, as a command. It follows docs/wire.md.

micropython main.py redis://localhost:6379 get arm.q
micropython main.py redis://localhost:6379 publish arm speed=0.5 mode=auto q=0,0.5,1
micropython main.py redis://localhost:6379 watch arm 10
micropython main.py redis://localhost:6379 call arm.plan goal=2 start=0,0.5
"""

import json
import sys

from messages import call, carried, clock, received
from places import Place, publish, read
from resp import Connection, Failure, check


def show(value):
    print(json.dumps(value))
    getattr(sys.stdout, "flush", id)()


def watch(server, place, most):
    """Print the value, then each update. After a gap, and if a notice has no value, print the value again."""
    check(not place.path, "watch a whole top-level key, such as arm")
    known, lost, note, stale, probe = {}, 0, None, True, clock() + 1

    def count(publisher, number):
        """Return how many updates of a publisher are missing before this one; None if the number goes back."""
        last = known.get(publisher, number - 1)
        if len(known) > 200:  # most have ended
            known.clear()
        known[publisher] = number
        return number - last - 1 if number > last else None

    server.subscribe(place.tag + ":notices")
    first = server.send("GET", place.tag + ":last")
    if first is not None:
        count(*noted(first))
    while most > 0:
        if stale:
            holder = read(server, place)
            while server.messages:  # what arrived before the reply is in it
                line, _ = received(server.messages.pop(0), 8, place)
                more = count(line[1], line[2])
                lost = None if None in (more, lost) else more + lost
            show({"kind": "read", "lost": lost, "path": [], "value": holder[0] if holder else None})
            lost, note, stale, most = 0, None, False, most - 1
            continue
        payload = server.wait(probe - clock())
        if payload is not None:
            line, data = received(payload, 8, place)
            lost = count(line[1], line[2])
            if lost != 0 or line[5] == "look":
                stale = True
            else:
                value = carried(data, line[6], line[7], place) if line[5] == "set" else None
                show({"kind": line[5], "lost": 0, "path": line[4], "value": value})
                most -= 1
        if clock() >= probe:  # the note names the last update: it must have arrived before the note
            note, probe = server.send("GET", place.tag + ":last"), clock() + 1
        if note is not None and not server.messages:
            publisher, number = noted(note)
            if known.get(publisher, 0) < number:
                known[publisher], stale, lost = number, True, None
            note = None


def noted(note):
    publisher, _, number = note.decode().partition(" ")
    return publisher, int(number)


def main(url, action, text, *words):
    server, place = Connection(url), Place(text)
    if action == "get":
        holder = read(server, place)
        check(holder, f"nothing is stored at {text}")
        show(holder[0])
    elif action == "publish":
        publish(server, place, words)
    elif action == "watch":
        watch(server, place, int(words[0]) if words else 1 << 60)
    else:
        check(action == "call", f"{action!r} is none of get, publish, watch and call")
        show(call(server, place, words))


try:
    check(len(sys.argv) > 3, "usage: main.py URL get|publish|watch|call PLACE [NAME=VALUE ... | COUNT]")
    main(*sys.argv[1:])
except KeyboardInterrupt:
    sys.exit(130)
except (Failure, OSError, ValueError, LookupError, TypeError, RuntimeError, MemoryError, AttributeError) as error:
    print("error:", " ".join((str(error) or repr(error)).split()), file=sys.stderr)
    sys.exit(1)
