"""Writer of ONNX files: a few nodes on one image of 3 channels."""

import struct


def field(number: int, value: int | bytes | str) -> bytes:
    """Encode a field of protocol buffers: a number, or bytes."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    data = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(data)) + data


def varint(value: int) -> bytes:
    """Encode seven bits per byte, lowest first."""
    out = b""
    while value > 127:
        out += bytes([value & 127 | 128])
        value >>= 7
    return out + bytes([value])


def model(nodes, constants, outputs) -> bytes:
    """Encode a model.

    Args:
        nodes: Kind, inputs and output of each.
        constants: Shape and numbers by name.
        outputs: Names; the input is named ``picture``.
    """

    def port(name: str) -> bytes:
        sides = b"".join(field(1, field(2, name + side)) for side in "nchw")
        return field(1, name) + field(2, field(1, field(1, 1) + field(2, sides)))

    graph = b"".join(
        field(1, b"".join(field(1, one) for one in into) + field(2, out) + field(4, kind))
        for kind, into, out in nodes
    )
    graph += field(2, "by hand")
    for name, (shape, values) in constants.items():
        sides = b"".join(field(1, side) for side in shape)
        raw = struct.pack(f"<{len(values)}f", *values)
        graph += field(5, sides + field(2, 1) + field(8, name) + field(9, raw))
    graph += field(11, port("picture")) + b"".join(field(12, port(name)) for name in outputs)
    return field(1, 8) + field(8, field(2, 13)) + field(7, graph)


def brightness() -> bytes:
    """Encode a network like U2-Net, whose saliency is the mean of the colours."""
    mean, std = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
    constants = {
        "weights": ((1, 3, 1, 1), tuple(each / 3 for each in std)),
        "mean": ((), (sum(mean) / 3,)),
    }
    nodes = [("Conv", ("picture", "weights"), "grey"), ("Add", ("grey", "mean"), "saliency")]
    return model(nodes, constants, ("saliency",))
