"""Large values from a publisher to subscribers of the same host and user, through shared memory.

The server still gets every update; its notice also says where the bytes are in the publisher's memory, and a
subscriber that can reach them there need not fetch them. `path.py` is what an interface has of it, `segment.py` the
memory of a publisher, the locks on its slots, and the views of a subscriber.

    publisher                                          subscriber
    segment.put(): lock a slot that no reader has
                   stamp 0, copy, new stamp, unlock
    notice (process, descriptor, slot, stamp)  ---->   reader.view(): open, lock, compare the stamp
                                                       the last view is gone: unlock

Whatever goes wrong on the way, the value is fetched from the server, as if this package were not there.
"""
