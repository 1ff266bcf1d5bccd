import numpy as np
import pytest

from echogrid.errors import UsageError
from echogrid.geometry import compose, inverse, wrap
from echogrid.output.graph_file import write_g2o


@pytest.fixture
def graph():
    """Poses of five nodes, and edges between them that are a little off; the last two are of a direction."""
    rng = np.random.default_rng(0)
    poses = rng.uniform(-3, 3, (5, 3))
    first, second = np.array([0, 1, 2, 0, 5, 5]), np.array([1, 2, 3, 4, 2, 3])
    direction = np.array([[0.0, 0.0, 0.7]])
    seen = compose(inverse(np.concatenate([poses, direction])[first]), poses[second])
    measured = seen + np.array([0.1, -0.05, 0.02]) * (first < 5)[:, None]
    root = rng.normal(size=(6, 3, 3))
    information = root @ root.swapaxes(1, 2)
    information[4:] = np.diag([0.0, 0.0, 50.0])
    return poses, first, second, measured, information


def read(path):
    """As g2o reads it: vertices by number; edges as both numbers, measured pose and information."""
    vertices, edges = {}, []
    for line in path.read_text().splitlines():
        tag, *fields = line.split()
        if tag == "VERTEX_SE2":
            number, *pose = fields
            vertices[int(number)] = np.array(pose, dtype=float)
        else:
            assert tag == "EDGE_SE2"
            a, b, c, d, e, f = map(float, fields[5:])
            matrix = np.array([[a, b, c], [b, d, e], [c, e, f]])
            edges.append((int(fields[0]), int(fields[1]), np.array(fields[2:5], dtype=float), matrix))
    return vertices, edges


def test_a_graph_comes_back(graph, tmp_path):
    poses, first, second, measured, information = graph
    write_g2o(tmp_path / "graph.g2o", *graph)
    vertices, edges = read(tmp_path / "graph.g2o")
    np.testing.assert_allclose([vertices[i] for i in range(5)], poses, atol=1e-6)
    assert [edge[:2] for edge in edges] == list(zip(first.tolist(), second.tolist(), strict=True))
    np.testing.assert_allclose([edge[2] for edge in edges], measured, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose([edge[3] for edge in edges], information, rtol=1e-8, atol=1e-12)
    assert {number for edge in edges for number in edge[:2]} <= set(vertices)


def test_a_direction_is_a_node_with_the_heading_that_its_edges_give_it(graph, tmp_path):
    write_g2o(tmp_path / "graph.g2o", *graph)
    vertices, edges = read(tmp_path / "graph.g2o")
    for i, j, measured, _ in edges[4:]:
        off = compose(inverse(vertices[i]), vertices[j])[2] - measured[2]
        assert abs(wrap(off)) < 1e-6
    np.testing.assert_allclose(vertices[5][:2], vertices[0][:2])


def test_a_place_where_no_file_can_be(graph, tmp_path):
    with pytest.raises(UsageError):
        write_g2o(tmp_path, *graph)
