"""All that exists only for data of REEM 0.0 and 0.1: telling it from data of today, and converting it.

    foo                the RedisJSON document, without what is not JSON
    foo&&&&metadata    a second document: which places of foo have ships' values, and the ships' labels
    foo.image          what the ship stored; of an array, a hash of arr, dtype, shape and strides

What is no dict was stored at the entry `%%%%ROOT%%%%` of a dict. `olddata.py` tells such data from new data with the
first read of a key: `plan/reads.py` imports it, the only place of the core that does. The other modules are
`reem migrate`: they use the core as any program would. Old names of classes and functions are in `reem/legacy.py`.
"""
