"""What can go wrong in extraction.

ExtractorError
├── DetectorFailed          a detector's model cannot be opened, or stopped on a picture
└── VideoError              a video that cannot be read, wholly or from some frame on
    ├── VideoUnreadable     not there, not a file, no permission, empty, or not a video
    ├── VideoHasNoFrames    a video whose frames cannot be decoded, not one of them
    ├── DecoderDied         the decoding process crashed or was killed; names the last good frame
    └── DecoderStalled      the decoding process said nothing for too long; it was ended
"""


class ExtractorError(Exception):
    """Base of every error that the package `extractors` raises."""


class DetectorFailed(ExtractorError):
    """A detector's model cannot be opened, or stopped on a picture."""


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
