"""A client of REEM with the modules that MicroPython has, for a server with the JSON module. It follows docs/wire.md.

micropython reem.py redis://localhost:6379 [get arm.q | publish arm JSON | watch arm.q LINES | call arm.plan JSON]"""

import json
import os
import select
import socket
import struct
import sys
import time


def check(ok, why):
    if not ok:
        raise ValueError(why)


def connect(channel=""):
    host, _, port = url.replace("redis://", "").partition(":")
    connection = socket.socket()
    connection.settimeout(5)
    connection.connect(socket.getaddrinfo(host, int(port or 6379), 0, socket.SOCK_STREAM)[0][-1])
    stream = connection.makefile("rb")
    if channel:
        connection.sendall(("SUBSCRIBE %s%s\r\n" % (tag, channel)).encode())
        next_lines(stream, "*$s${:")  # a list of the word subscribe, the channel, and a number
    return connection, stream


def next_lines(stream, kinds):
    """Read lines of these kinds (: a number, $ and * how many bytes or items follow) and return the last number."""
    line = b":0"
    for kind in kinds:
        line = stream.readline(4096) or b""
        check(line[-2:] == b"\r\n", "the server closed the connection, or does not answer")
        check(line[:1] != b"-", "the server refused: " + line[1:].decode())
        check(line[:1] == kind.encode(), "the server sent another reply than expected")
    return int(line[1:]) if line[:1] in b":$*" else 0


def next_text(stream):
    size = next_lines(stream, "$")
    if size == -1:
        return None
    check(0 <= size < 1 << 26, "the server announced a text of %d bytes" % size)
    found = stream.read(size + 2)
    check(found[size:] == b"\r\n", "the server sent a text of another size than it announced")
    return found[:size]


def ask(kinds, *commands):
    for words in commands:
        sized = [b"$%d\r\n%s\r\n" % (len(word), word) for word in [word.encode() for word in words]]
        server.sendall(b"*%d\r\n" % len(words) + b"".join(sized))
    return next_lines(replies, kinds)


def arrives(connection, seconds):
    poll = select.poll()
    poll.register(connection, select.POLLIN)
    return poll.poll(1000 * seconds)


def shown(text, npy):
    """Return JSON as it is, or the array for its placeholder."""
    if npy is None or not text.startswith('"$ship numpy %s ' % path):
        check('"$ship ' not in text, place + " has more than JSON: get one array, such as arm.q")
        return text
    items = len(npy) // 8 - 16
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (%d,), }" % items
    start = b"\x93NUMPY\x01\x00v\x00%-117s\n" % header
    check(len(npy) % 8 == 0 and npy[:128] == start, place + " is not an array of float64 with one dimension")
    return json.dumps({"dtype": "<f8", "shape": [items], "data": list(struct.unpack("<%dd" % items, npy[128:]))})


def read():
    """Return value and note of one instant. The note is publisher and number of the last update."""
    reads = [["JSON.GET", key, "$" + path], ["GET", tag + path], ["GET", tag + ":last"]]
    check(ask("++++*", ["MULTI"], *reads, ["EXEC"]) == 3, "the server did not read")
    text, npy, note = [next_text(replies) for _ in range(3)]
    text = (text or b"[]").decode()
    check(text[0] + text[-1] == "[]", "the server sent another reply than expected")  # a list of one value
    check(len(text) > 2 or action == "watch", "nothing is stored at " + place)
    return shown(text[1:-1], npy), note.decode() if note else None


def watch(lines):
    """Print the value, and again after each change. A notice is a reason to read, and each second is one."""
    notices, lines, last, known = connect(":notices")[0], int(lines or -1), None, None
    while lines != 0:
        text, note = read()
        known = note or known  # a note expires
        if (text, known) != last:
            print('{"update":%s,"value":%s}' % (json.dumps(known), text or "null"))
            last, lines = (text, known), lines - 1
        elif arrives(notices, 1):
            check(notices.recv(4096), "the server closed the connection")


def publish(text):
    """Replace a key by JSON and have its subscribers read it, in one transaction. RedisJSON reads 15 digits exactly."""
    digits = "".join(["0" if it in "0123456789." else it.lower() for it in text])
    check("0" * 17 not in digits and "0e" not in digits, "a number has over 15 digits or an exponent")
    check(not path and '"$ship ' not in text, "publish a whole key, such as arm, without a text that begins with $ship")
    ask("+", ["WATCH", key, tag + ":ships", tag + ":lease"])
    check(ask(":", ["EXISTS", tag + ":lease"]) == 0, key + " is owned by another program")
    check(ask(":", ["EXISTS", tag + ":ships"]) == 0, key + " has arrays, which this client would leave behind")
    ask("", ["JSON.TYPE", key])
    next_text(replies)  # an error for a key of another program
    notify = ["PUBLISH", tag + ":notices", json.dumps([1, me, 1, time.time(), [], "look", 0, []]) + "\n"]
    note = ["SET", tag + ":last", me + " 1", "EX", "60"]
    count = ask("++++*", ["MULTI"], ["JSON.SET", key, "$", text], note, notify, ["EXEC"])
    check(count == 3, "another client wrote %s at the same time: publish again" % key)
    next_lines(replies, "++:")


def call(text):
    """Send arguments to one program that serves, and print its answer. Both sides give up after ten seconds."""
    connection, answers = connect(":answers@" + me)
    servers = ask("*", ["PUBSUB", "CHANNELS", tag + path + ":serve@" + "?" * 16])
    check(servers > 0, "no program serves " + place)
    channel = [next_text(replies) for _ in range(servers)][-1].decode()
    head = json.dumps([1, "call", me, me, 10, ["", ""], "here", len(text.encode()), []])
    check(ask(":", ["PUBLISH", channel, head + "\n" + text]), "the program that served it has just ended: call again")
    check(arrives(connection, 10), "no answer in 10 s; the call may or may not have been handled")
    next_lines(answers, "*$m${")  # a list of the word message, the channel, and what was published
    line, _, answer = next_text(answers).partition(b"\n")
    version, kind, number, sender, _, texts, where, size, _ = json.loads(line)
    check([version, number, sender] == [1, me, channel[-16:]], "an answer to something else")
    check(kind == "answer", kind + ": " + json.dumps(texts))
    check(where == "here" and size == len(answer), "the answer has arrays, or over 64 kB")
    print(shown(answer.decode(), None))


try:
    url, action, place, word = (sys.argv + [""] * 4)[1:5]
    actions = {"get": lambda _: print(read()[0]), "publish": publish, "watch": watch, "call": call}
    check(action in actions, "usage: reem.py URL get|publish|watch|call PLACE [JSON | LINES]")
    key = place.replace("[", ".").split(".")[0]
    path, tag, me = place[len(key) :], "{%s}" % key, os.urandom(8).hex()
    is_plain = not [it for it in place if it not in "_.[]:" and not ("0" <= it <= "9" or "a" <= it.lower() <= "z")]
    check(key and is_plain and ".." not in path, place + " is not like arm.joints[0]")
    json.loads(word if action in ("publish", "call") else "0")
    server, replies = connect()
    actions[action](word)
except (OSError, ValueError, TypeError, AttributeError, MemoryError) as error:
    print("error:", " ".join(str(error).split()), file=sys.stderr)
    sys.exit(1)
