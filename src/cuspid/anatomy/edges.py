"""Edges of triangle meshes: which are open, what they close to, and which faces they join."""

import numpy as np
from jaxtyping import Int

from cuspid.model.mesh import edges_of


def open_edges(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "e 2"]:
    """Directed edges without their opposite."""
    directed = edges_of(faces)
    size = int(faces.max(initial=-1)) + 1
    keys, opposite = directed[:, 0] * size + directed[:, 1], directed[:, 1] * size + directed[:, 0]
    return directed[~np.isin(keys, opposite)]


def describe_edges(faces: Int[np.ndarray, "f 3"]) -> str:
    """How many edges are open, shared by more than two faces, or run twice in one direction."""
    directed = edges_of(faces)
    _, counts = np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)
    _, twice = np.unique(directed, axis=0, return_counts=True)
    return (
        f"{(counts == 1).sum()} open edges, {(counts > 2).sum()} shared by more than two faces, "
        f"{(twice > 1).sum()} doubled"
    )


def loops_of(edges: Int[np.ndarray, "e 2"]) -> list[Int[np.ndarray, "_"]]:
    """Closed walks along directed edges, each edge once; a walk that comes back to one of its points closes there."""
    following: dict[int, list[int]] = {}
    for start, end in edges.tolist():
        following.setdefault(start, []).append(end)
    loops = []
    for first in list(following):
        while following[first]:
            walk, place = [first], {first: 0}
            while True:
                ends = following.get(walk[-1])
                if not ends:
                    break
                node = ends.pop()
                if node in place:
                    loops.append(np.array(walk[place[node] :]))
                    for left in walk[place[node] + 1 :]:
                        del place[left]
                    walk = walk[: place[node] + 1]
                    if not following[walk[-1]] and node == first:
                        break
                else:
                    place[node] = len(walk)
                    walk.append(node)
            if len(walk) > 1 or not following[first]:
                break
    return loops


def neighbours_of(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "p 2"]:
    """Pairs (p, 2) of faces that share an edge, in both orders, for a closed mesh."""
    edges = np.sort(edges_of(faces), axis=1)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    assert np.array_equal(edges[order[::2]], edges[order[1::2]]), "the mesh is not closed"
    pairs = (order // 3).reshape(-1, 2)
    return np.concatenate([pairs, pairs[:, ::-1]])
