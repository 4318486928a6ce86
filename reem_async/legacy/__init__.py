"""Detect and convert data of REEM 0.0 and 0.1.

    foo                the RedisJSON document, without values that are not JSON
    foo&&&&metadata    the second document: which places of foo have ships' values, and the ships' labels
    foo.image          the value of a ship; of an array, a hash of arr, dtype, shape and strides

A value that is no dict was stored at the entry `%%%%ROOT%%%%` of a dict. `olddata.py` detects such data with the first
read of a key: only `plan/reads.py` imports it. The other modules are `reem migrate`, and use the core as any program
would. Old names of classes and functions are in `reem/legacy.py`.
"""
