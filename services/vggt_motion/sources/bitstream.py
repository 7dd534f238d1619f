"""The picture size that a coded video packet announces, without decoding it.

OpenCV scales every frame of a video to the size of the first without a word; a change of size in mid-stream would thus
change the camera unseen. So the packets are looked at beside the decoder. Known are H.264, HEVC, VP8, VP9 (key frames),
MPEG-1/2, MPEG-4 part 2 and Motion JPEG; packets of other codecs say nothing here.
"""

from __future__ import annotations

from collections.abc import Callable, Container

Size = tuple[int, int]  # width, height in pixels

_START = b"\0\0\1"
_EXTENDED_PROFILES = frozenset({44, 83, 86, 100, 110, 118, 122, 128, 134, 135, 138, 139, 144, 244})
_MACROBLOCK_PX = 16
_MAX_EXPONENT = 31
_HEVC_PROFILE_BITS, _HEVC_LEVEL_BITS = 88, 8


def size_reader(fourcc: str) -> Callable[[bytes], Size | None] | None:
    """What reads the size from packets of a codec, by its FourCC; None for a codec that is not known here.

    The reader returns None for packets that announce no size (most of them), and for what it cannot make out.
    """
    name = fourcc.lower()
    for names, reader in _READERS:
        if name in names:
            return lambda packet: _guarded(reader, packet)
    return None


def _guarded(reader: Callable[[bytes], Size | None], packet: bytes) -> Size | None:
    try:
        return reader(packet)
    except (IndexError, ValueError):
        return None  # cut off or damaged: the decoder will have its say


class _Bits:
    """Reads bits, most significant first; IndexError at the end."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._position = 0

    def read(self, count: int) -> int:
        value = 0
        for _ in range(count):
            byte, bit = divmod(self._position, 8)
            value = (value << 1) | ((self._data[byte] >> (7 - bit)) & 1)
            self._position += 1
        return value

    def unsigned(self) -> int:
        """Exponential Golomb code, ue(v)."""
        zeros = 0
        while self.read(1) == 0:
            zeros += 1
            if zeros > _MAX_EXPONENT:
                raise ValueError("no exponential Golomb code")
        return (1 << zeros) - 1 + self.read(zeros)

    def signed(self) -> int:
        """Exponential Golomb code, se(v)."""
        code = self.unsigned()
        return (code + 1) // 2 if code % 2 else -(code // 2)


def _h264(packet: bytes) -> Size | None:
    """Sequence parameter set in Annex B form (ITU-T H.264, 7.3.2.1.1)."""
    bits = _parameter_set(packet, lambda header: header & 0x1F, pictures=(1, 5), wanted=7, header_bytes=1)
    return None if bits is None else _h264_size(bits)


def _parameter_set(
    packet: bytes, kind_of: Callable[[int], int], *, pictures: Container[int], wanted: int, header_bytes: int
) -> _Bits | None:
    """Content of the first unit of a kind in Annex B form, unless a picture comes first: what announces it is ahead."""
    begin = packet.find(_START)
    while begin >= 0:
        unit = begin + len(_START)
        kind = kind_of(packet[unit])
        if kind in pictures:
            return None
        following = packet.find(_START, unit)
        if kind == wanted:
            end = len(packet) if following < 0 else following
            return _Bits(packet[unit + header_bytes : end].replace(b"\0\0\3", b"\0\0"))
        begin = following
    return None


def _h264_size(bits: _Bits) -> Size:
    profile = bits.read(8)
    bits.read(16)  # constraints and level
    bits.unsigned()  # id
    chroma = 1
    if profile in _EXTENDED_PROFILES:
        chroma = bits.unsigned()
        if chroma == 3:
            bits.read(1)  # separate colour planes
        bits.unsigned()  # bit depths
        bits.unsigned()
        bits.read(1)
        if bits.read(1):
            for matrix in range(12 if chroma == 3 else 8):
                if bits.read(1):
                    _skip_scaling_list(bits, 16 if matrix < 6 else 64)
    bits.unsigned()  # frame numbers
    order = bits.unsigned()
    if order == 0:
        bits.unsigned()
    elif order == 1:
        bits.read(1)
        bits.signed()
        bits.signed()
        for _ in range(bits.unsigned()):
            bits.signed()
    bits.unsigned()  # reference frames
    bits.read(1)
    width = (bits.unsigned() + 1) * _MACROBLOCK_PX
    map_units = bits.unsigned() + 1
    is_progressive = bits.read(1)
    height = (2 - is_progressive) * map_units * _MACROBLOCK_PX
    if not is_progressive:
        bits.read(1)
    bits.read(1)
    if bits.read(1):
        left, right, top, bottom = (bits.unsigned() for _ in range(4))
        unit_x = 2 if chroma in (1, 2) else 1
        unit_y = (2 if chroma == 1 else 1) * (2 - is_progressive)
        width -= unit_x * (left + right)
        height -= unit_y * (top + bottom)
    return width, height


def _skip_scaling_list(bits: _Bits, size: int) -> None:
    last = following = 8
    for _ in range(size):
        if following != 0:
            following = (last + bits.signed()) % 256
        last = following or last


def _hevc(packet: bytes) -> Size | None:
    """Sequence parameter set in Annex B form (ITU-T H.265, 7.3.2.2)."""
    bits = _parameter_set(packet, lambda header: (header >> 1) & 0x3F, pictures=range(32), wanted=33, header_bytes=2)
    return None if bits is None else _hevc_size(bits)


def _hevc_size(bits: _Bits) -> Size:
    bits.read(4)  # id of the video parameter set
    sub_layers = bits.read(3)
    bits.read(1)
    bits.read(_HEVC_PROFILE_BITS + _HEVC_LEVEL_BITS)
    present = [(bits.read(1), bits.read(1)) for _ in range(sub_layers)]
    if sub_layers:
        bits.read(2 * (8 - sub_layers))
    for has_profile, has_level in present:
        bits.read(_HEVC_PROFILE_BITS * has_profile + _HEVC_LEVEL_BITS * has_level)
    bits.unsigned()  # id
    chroma = bits.unsigned()
    if chroma == 3:
        bits.read(1)  # separate colour planes
    width, height = bits.unsigned(), bits.unsigned()
    if bits.read(1):
        left, right, top, bottom = (bits.unsigned() for _ in range(4))
        width -= (2 if chroma in (1, 2) else 1) * (left + right)
        height -= (2 if chroma == 1 else 1) * (top + bottom)
    return width, height


def _vp8(packet: bytes) -> Size | None:
    """Frame header of a key frame (RFC 6386, 9.1)."""
    if packet[0] & 1 or packet[3:6] != b"\x9d\x01\x2a":
        return None
    mask = 0x3FFF  # the upper two bits ask for scaling
    return int.from_bytes(packet[6:8], "little") & mask, int.from_bytes(packet[8:10], "little") & mask


def _vp9(packet: bytes) -> Size | None:
    """Uncompressed header of a key frame (VP9 specification, 6.2)."""
    bits = _Bits(packet)
    if bits.read(2) != 2:
        return None
    profile = bits.read(1) | (bits.read(1) << 1)
    if profile == 3:
        bits.read(1)
    is_repeat, is_inter = bits.read(1), bits.read(1)
    bits.read(2)
    if is_repeat or is_inter or bits.read(24) != 0x498342:
        return None
    if profile >= 2:
        bits.read(1)  # ten or twelve bits
    has_subsampling = profile in (1, 3)
    if bits.read(3) != 7:  # not sRGB
        bits.read(1)
        bits.read(3 if has_subsampling else 0)
    elif has_subsampling:
        bits.read(1)
    return bits.read(16) + 1, bits.read(16) + 1


def _mpeg2(packet: bytes) -> Size | None:
    """Sequence header (ISO/IEC 13818-2, 6.2.2.1)."""
    begin = packet.find(b"\0\0\1\xb3")
    if begin < 0:
        return None
    high, middle, low = packet[begin + 4 : begin + 7]
    return (high << 4) | (middle >> 4), ((middle & 0x0F) << 8) | low


def _mpeg4(packet: bytes) -> Size | None:
    """Video object layer of rectangular shape (ISO/IEC 14496-2, 6.2.3)."""
    begin = packet.find(_START)
    while begin >= 0 and not 0x20 <= packet[begin + 3] <= 0x2F:
        begin = packet.find(_START, begin + 3)
    if begin < 0:
        return None
    bits = _Bits(packet[begin + 4 : begin + 64])
    bits.read(9)  # random access, type
    version = 1
    if bits.read(1):
        version = bits.read(4)
        bits.read(3)
    if bits.read(4) == 15:
        bits.read(16)  # aspect
    if bits.read(1):
        bits.read(3)
        if bits.read(1):
            bits.read(79)  # rate control
    shape = bits.read(2)
    if shape == 3 and version != 1:
        bits.read(4)
    bits.read(1)
    resolution = bits.read(16)
    bits.read(1)
    if bits.read(1):
        bits.read(max(1, (resolution - 1).bit_length()))
    if shape != 0:
        return None
    bits.read(1)
    width = bits.read(13)
    bits.read(1)
    return width, bits.read(13)


def _jpeg(packet: bytes) -> Size | None:
    """Frame header (ITU-T T.81, B.2.2)."""
    position = 2
    while packet[position] == 0xFF:
        marker = packet[position + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = packet[position + 5 : position + 7], packet[position + 7 : position + 9]
            return int.from_bytes(width, "big"), int.from_bytes(height, "big")
        position += 2 + int.from_bytes(packet[position + 2 : position + 4], "big")
    return None


_READERS: tuple[tuple[frozenset[str], Callable[[bytes], Size | None]], ...] = (
    (frozenset({"h264", "avc1", "avc3", "x264"}), _h264),
    (frozenset({"hevc", "hvc1", "hev1", "h265", "x265"}), _hevc),
    (frozenset({"vp80"}), _vp8),
    (frozenset({"vp90"}), _vp9),
    (frozenset({"mpg1", "mpg2", "mpeg", "mp2v", "m2v1"}), _mpeg2),
    (frozenset({"fmp4", "mp4v", "xvid", "divx", "dx50"}), _mpeg4),
    (frozenset({"mjpg", "jpeg", "mjpa"}), _jpeg),
)
