"""The node of a guardian publishes each whole message of its standard input once there is a subscriber."""

import io

from hypothesis import given
from hypothesis import strategies as st

from retrim.plants.bridges.target_guardian import frame
from retrim.ros2.relay import publish_frames


@given(st.lists(st.binary(max_size=300), max_size=8), st.integers(0, 4))
def test_whole_messages_are_published_unchanged(messages, lost):
    """A pipe that ends within a message loses only this message."""
    data = b"".join(frame(each) for each in messages)
    data, whole = (data[:-lost], messages[:-1]) if lost and messages else (data, messages)
    published, looks = [], iter((False, False, True))
    publish_frames(published.append, lambda: next(looks), io.BytesIO(data).read)
    assert published == whole
