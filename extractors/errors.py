"""What can go wrong in extraction.

ExtractorError
├── DetectorFailed          a detector's model cannot be opened, or stopped on a picture
├── BadAddress              an address that is none, or not of a protocol that is read, or a login that is none
├── Stopped                 the caller wants no more of a live stream, before its first picture came
├── MaskUnreadable          an area to ignore that cannot be read, or does not fit the video
└── VideoError              a video that cannot be read, wholly or from some frame on
    ├── VideoUnreadable     not there, not a file, no permission, empty, or not a video
    ├── VideoHasNoFrames    a video whose frames cannot be decoded, not one of them
    ├── DecoderDied         the decoding process crashed or was killed; names the last good frame
    ├── DecoderStalled      the decoding process said nothing for too long; it was ended
    └── StreamLost          a live stream that stayed away for longer than it is waited for
"""


class ExtractorError(Exception):
    """Base of every error that the package `extractors` raises."""


class DetectorFailed(ExtractorError):
    """A detector's model cannot be opened, or stopped on a picture."""


class BadAddress(ExtractorError):
    """An address that is none, or not of a protocol that is read, or a login that is none."""


class Stopped(ExtractorError):
    """The caller wants no more of a live stream."""


class MaskUnreadable(ExtractorError):
    """An area to ignore that cannot be read, or does not fit the video."""


class VideoError(ExtractorError):
    """A video that cannot be read, wholly or from some frame on."""


class VideoUnreadable(VideoError):
    """Not there, not a file, no permission, empty, or not a video."""


class VideoHasNoFrames(VideoError):
    """A video of which not one frame can be decoded."""


class DecoderDied(VideoError):
    """The decoding process ended before the video did; all frames before that were given."""


class DecoderStalled(VideoError):
    """The decoding process said nothing for longer than the limit, and was ended."""


class StreamLost(VideoError):
    """A live stream was interrupted for longer than the limit."""
