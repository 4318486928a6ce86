"""Documents and arrays of REEM (docs/wire.md), with the modules that MicroPython has."""

import json
import math
import struct

from resp import Failure, check

CODES = {"b1": "B", "i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "i8": "q", "u8": "Q"}
CODES.update({"f4": "f", "f8": "d"})  # dtypes of numpy, and their codes in struct


def placeholders(holder, where):
    """Return container, key and suffix for each array in the only item of a list; texts and floats are put in place."""
    stack, found = [holder], []
    while stack:
        at = stack.pop()
        for key in range(len(at)) if isinstance(at, list) else list(at):
            it = at[key]
            if isinstance(it, (list, dict)):
                stack.append(it)
            elif isinstance(it, str) and it.startswith("$ship "):
                label, _, rest = it[6:].partition(" ")
                if label == "text":
                    at[key] = rest
                elif label == "float":
                    digits, _, power = rest.replace("0x", "", 1).partition("p")
                    whole, _, fraction = digits.partition(".")
                    at[key] = math.ldexp(int(whole + fraction, 16), int(power) - 4 * len(fraction))
                else:
                    check(label == "numpy", f"{where}: this client cannot read a value of the kind {label!r}")
                    check("%" not in rest, f"{where}: this client reads arrays with plain names only")
                    found.append((at, key, rest.split(" ")[0]))
    check(len({name for _, _, name in found}) == len(found), f"{where}: two places have the same array")
    return found


def filled(holder, found, blobs, where):
    """Return the item of `holder` with its arrays, whose bytes are in the order of what was `found`."""
    for (at, key, suffix), blob in zip(found, blobs):
        at[key] = array(blob, where + suffix)
    return holder[0]


def array(blob, where):
    """Return dtype, shape and items of an .npy file."""
    check(isinstance(blob, bytes), f"{where}: the array is gone from the server")
    try:
        check(blob[:8] == b"\x93NUMPY\x01\x00" and len(blob) > 10, "it is no .npy file of version 1")
        start = 10 + struct.unpack("<H", blob[8:10])[0]
        check(start < 1 << 10, "its header is too long")
        header = blob[10:start].decode().replace("'", '"').replace("(", "[").replace(",)", "]").replace(")", "]")
        fields = json.loads(header.replace(", }", "}").replace("False", "false"))
        dtype, shape, count = fields["descr"], fields["shape"], 1
        order, code = ">" if dtype[0] == ">" else "<", CODES[dtype[1:]]
        for size in shape:
            check(isinstance(size, int) and 0 <= size < 1 << 32, "its shape is wrong")
            count *= size
        is_whole = count * struct.calcsize(order + code) == len(blob) - start
        check(fields["fortran_order"] is False and is_whole, "its size is wrong")
        items = list(struct.unpack(order + str(count) + code, blob[start:]))
        return {"dtype": dtype, "shape": shape, "data": [bool(it) for it in items] if "b" in dtype else items}
    except (ValueError, KeyError, IndexError, TypeError, Failure) as error:
        raise Failure(f"{where}: this client cannot read the array {blob[:80]!r}: {error!r}") from None


def number_text(number):
    """Return the JSON of a number, exact on each server: long floats are hexadecimal."""
    if isinstance(number, int):
        check(-(1 << 63) <= number < 1 << 64, "an integer has up to 64 bits")
        return str(number)
    check(number - number == 0, f"{number!r} is no number of JSON")
    text = repr(number)
    if "e" not in text and len(text) <= 16:  # a point, and up to 15 digits
        return text
    fraction, power = math.frexp(abs(number))
    return '"$ship float %s0x%xp%d"' % ("-" if number < 0 else "", int(fraction * (1 << 53)), power - 53)


def encoded(words, above):
    """Return the text of a document, and parts and bytes of its arrays, for words such as `speed=0.5`, `q=0,0.5`.

    A value is a number, an array of float64 if there is a comma, or else text. `above` is the path of the document.
    """
    members, parts, blobs = [], [], []
    for word in words:
        name, sign, text = word.partition("=")
        check(sign and name and not [it for it in name if it in ".[]\"'\\~% "], f"{word!r} is not like name=value")
        is_text = [1 for sign in text if sign not in "0123456789+-.eE,"]
        try:
            items = [] if is_text else [it for it in text.split(",") if it]
            numbers = [int(it) if it.lstrip("-").isdigit() else float(it) for it in items]
        except ValueError:
            numbers = []
        if numbers and "," in text:
            header = "{'descr': '<f8', 'fortran_order': False, 'shape': (%d,), }" % len(numbers)
            header += " " * (-(len(header) + 11) % 64) + "\n"
            before = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode()
            blobs.append(before + struct.pack("<%dd" % len(numbers), *numbers))
            parts.append(["numpy", f"{above}.{name}", len(blobs[-1])])
            value = json.dumps("$ship numpy %s.%s %d float64[%d]" % (above, name, 8 * len(numbers), len(numbers)))
        elif numbers:
            value = number_text(numbers[0])
        else:
            value = json.dumps("$ship text " + text if text.startswith("$ship ") else text)
        members.append(json.dumps(name) + ":" + value)
    return ("{" + ",".join(members) + "}").encode(), parts, blobs
