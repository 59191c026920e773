"""Fields that many requests share: request ids, page sizes, page tokens (the last row's id)."""

from __future__ import annotations

from magic_core.errors import InvalidInput
from magic_core.wire.header_check import request_id_problem

MAX_PAGE_SIZE = 1000


def check_request_id(request_id: str) -> None:
    """Raise InvalidInput unless it is 1 to 128 printable characters."""
    if problem := request_id_problem(request_id):
        raise InvalidInput.field("request_id", problem)


def page_limit(page_size: int, *, default: int = 100) -> int:
    """The number of rows of a page; InvalidInput above 1000."""
    if page_size > MAX_PAGE_SIZE:
        raise InvalidInput.field("page_size", f"{page_size}, expected 0 to {MAX_PAGE_SIZE}")
    return page_size or default


def page_start(page_token: str) -> int:
    """The row id that a token stands for, 0 for the first page."""
    if not page_token:
        return 0
    if not (page_token.isascii() and page_token.isdigit() and len(page_token) < 18):
        raise InvalidInput.field("page_token", "not a token that this server gave out")
    return int(page_token)


def token_of(following: int | None) -> str:
    """The token of the next page; empty on the last."""
    return "" if following is None else str(following)
