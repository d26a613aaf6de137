"""Where an extraction goes on: behind what it stored before it was killed, or before the log was restored."""

from events import StreamName
from store import Appender, Log


def resume(log: Log, appender: Appender, stream: StreamName, started_position: int) -> int:
    """Let the appender go on where the stream stood when the process started; how many events all its lives had then.

    What the process stored since is compared as it comes again, in a life from before the log was restored, too.

    Args:
        log: The log.
        appender: Whose next batch of the stream it is.
        stream: The stream.
        started_position: Where the process's start is in the log.
    """
    here = log.stream_head(stream, at_position=started_position).sequence
    at_start, said = here, 0
    for life in log.lives(stream):
        if life.epoch < log.epoch:
            # What was said before the log was restored stays: the process goes on behind it.
            then = log.stream_head(stream, epoch=life.epoch, at_position=started_position).sequence
            at_start, said = at_start + then, said + life.sequence - then
    appender.resume_at(stream, here - said)
    return at_start
