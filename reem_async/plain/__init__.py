"""Documents on servers without the JSON module: strings that hold the same JSON text.

Pure: commands in, commands out. `documents` does to a text what the module does to a document, `translation` turns a
batch of commands into what any Redis takes. Only the transports use it, and only with servers that lack the module; the
plans above send the same commands to both.
"""
