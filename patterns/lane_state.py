def saved_lane(lane, name):
    raise NotImplementedError


def restored_lane(*a, **k):
    raise NotImplementedError
