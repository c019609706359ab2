"""Opening the database file: settings that are read back, the schema, and the errors in our words."""

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import sqlalchemy as sa
from sqlalchemy.pool import StaticPool

from controller.store import schema
from estimation.errors import StoreError

MEMORY: Final = Path(":memory:")
_SYNCHRONOUS: Final = {"OFF": 0, "FULL": 2}
_BUSY_TIMEOUT_MS: Final = 2000


def connect(path: Path, durable: bool, read_only: bool) -> sa.Connection:
    """The one connection of a store, with its schema in the present form.

    Raises StoreError: not a database, not durable as asked, a schema of newer software.
    """
    try:
        connection = _engine(path, durable, read_only).connect()
        version = _schema_version(connection)
        if version is None and not read_only:
            with connection.begin():
                schema.create(connection)
        elif version != schema.HEAD:
            if version is None or read_only or version > schema.HEAD:
                raise StoreError(
                    f"Store {path} has schema {version}, this software reads {schema.HEAD}",
                    "Use the software that wrote it; an older store is migrated when a daemon starts on it",
                )
            migrate(connection, path)
    except (sa.exc.DBAPIError, sqlite3.Error) as error:
        raise StoreError(f"Store {path} cannot be opened: {reason(error)}", _remedy(error)) from error
    return connection


def _engine(path: Path, durable: bool, read_only: bool) -> sa.Engine:
    uri = (
        "file::memory:"
        if path == MEMORY
        else f"{path.absolute().as_uri()}?mode={'ro' if read_only else 'rwc'}"
    )
    synchronous = "FULL" if durable else "OFF"

    def open_connection() -> sqlite3.Connection:
        # Transactions are begun by the event below: sqlite3's own begin is deferred and comes too late.
        return sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)

    engine = sa.create_engine("sqlite://", creator=open_connection, poolclass=StaticPool)

    @sa.event.listens_for(engine, "connect")
    def configure(connection: sqlite3.Connection, _record: object) -> None:
        connection.execute(f"PRAGMA busy_timeout = {_BUSY_TIMEOUT_MS}")
        connection.execute("PRAGMA foreign_keys = ON")
        if read_only:
            return
        journal = connection.execute("PRAGMA journal_mode = WAL").fetchone()[0]
        connection.execute(f"PRAGMA synchronous = {synchronous}")
        if durable:
            _require_durable(path, connection, journal)

    @sa.event.listens_for(engine, "begin")
    def begin(connection: sa.Connection) -> None:
        connection.exec_driver_sql("BEGIN" if read_only else "BEGIN IMMEDIATE")

    return engine


def _require_durable(path: Path, connection: sqlite3.Connection, journal: str) -> None:
    level = connection.execute("PRAGMA synchronous").fetchone()[0]
    if journal != "wal" or level != _SYNCHRONOUS["FULL"]:
        raise StoreError(
            f"Store {path} got journal mode {journal}, synchronous {level} instead of wal, "
            f"{_SYNCHRONOUS['FULL']}",
            "Put it on a local disk whose file system supports locking and shared memory",
        )


def _schema_version(connection: sa.Connection) -> str | None:
    """The revision of the store, None for an empty file. Raises StoreError for a stranger's database."""
    with connection.begin():
        names = set(connection.scalars(sa.text("SELECT name FROM sqlite_master WHERE type = 'table'")))
        if not names:
            return None
        if "alembic_version" not in names:
            raise StoreError("The file is a database, but not a truecell store", "Give another --state-dir")
        return str(connection.scalar(sa.text("SELECT version_num FROM alembic_version")))


def migrate(connection: sa.Connection, path: Path) -> None:
    """Bring an older store to the present schema, after a copy of it was put beside it."""
    from alembic import command
    from alembic.config import Config

    if path != MEMORY:
        copy = sqlite3.connect(path.with_name(f"{path.name}.before-{schema.HEAD}"))
        connection.connection.dbapi_connection.backup(copy)  # type: ignore[union-attr]
        copy.close()
    config = Config()
    config.set_main_option("script_location", str(Path(__file__).parent / "migrations"))
    config.attributes["connection"] = connection
    with connection.begin():
        command.upgrade(config, "head")


def reason(error: BaseException) -> str:
    """The database's own words, without SQLAlchemy's frame around them."""
    return str(getattr(error, "orig", None) or error)


def is_fatal(error: BaseException) -> bool:
    """After a failed write to the medium nothing that was not yet durable can be trusted again."""
    text = reason(error)
    return "disk I/O error" in text or "malformed" in text


def _remedy(error: BaseException) -> str:
    text = reason(error)
    if "full" in text:
        return "Free space on that disk"
    if "readonly" in text or "unable to open" in text:
        return "Check that the folder exists and that this user may write there"
    if "not a database" in text or "malformed" in text:
        return "Keep the file for analysis and restore a backup"
    if "locked" in text:
        return "Another program has the store open for writing; close it"
    return "Check the disk and the system log"


@contextmanager
def in_our_words(what: str) -> Iterator[None]:
    """Turn a database error into a StoreError that says what was not done."""
    try:
        yield
    except sa.exc.DBAPIError as error:
        raise StoreError(f"{what}: {reason(error)}", _remedy(error)) from error
