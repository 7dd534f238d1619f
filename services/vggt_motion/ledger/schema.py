"""The tables, as migrations: entry n leads from schema version n to n + 1 and is never changed once released.

Plain SQL that PostgreSQL understands as well, but for the names of types (BLOB is BYTEA there).
"""

from __future__ import annotations

MIGRATIONS: tuple[tuple[str, ...], ...] = (
    (
        "CREATE TABLE meta (key TEXT NOT NULL PRIMARY KEY, value TEXT NOT NULL)",
        "CREATE TABLE streams (stream TEXT NOT NULL PRIMARY KEY, next_sequence BIGINT NOT NULL)",
        """CREATE TABLE records (
            stream TEXT NOT NULL,
            sequence BIGINT NOT NULL,
            record_id TEXT NOT NULL,
            payload_type TEXT NOT NULL,
            payload BLOB NOT NULL,
            identity_sha256 BLOB NOT NULL,
            append_time_ns BIGINT NOT NULL,
            row_sha256 BLOB NOT NULL,
            PRIMARY KEY (stream, sequence),
            UNIQUE (stream, record_id)
        )""",
        "CREATE TABLE blobs (sha256 TEXT NOT NULL PRIMARY KEY, size_bytes BIGINT NOT NULL)",
        """CREATE TABLE record_blobs (
            stream TEXT NOT NULL,
            sequence BIGINT NOT NULL,
            sha256 TEXT NOT NULL REFERENCES blobs (sha256),
            PRIMARY KEY (stream, sequence, sha256),
            FOREIGN KEY (stream, sequence) REFERENCES records (stream, sequence)
        )""",
    ),
    (
        """CREATE TABLE jobs (
            job_id TEXT NOT NULL PRIMARY KEY,
            submission BIGINT NOT NULL UNIQUE,
            kind TEXT NOT NULL,
            model TEXT NOT NULL,
            priority INTEGER NOT NULL,
            payload_type TEXT NOT NULL,
            payload BLOB NOT NULL,
            state TEXT NOT NULL,
            attempt INTEGER NOT NULL,
            failure_count INTEGER NOT NULL,
            lost_lease_count INTEGER NOT NULL,
            lease_id TEXT NOT NULL,
            worker TEXT NOT NULL,
            deadline_s DOUBLE PRECISION NOT NULL,
            not_before_s DOUBLE PRECISION NOT NULL,
            last_reason TEXT NOT NULL,
            last_traceback TEXT NOT NULL
        )""",
        "CREATE INDEX jobs_by_state ON jobs (state, priority, submission)",
        """CREATE TABLE leases (
            lease_id TEXT NOT NULL PRIMARY KEY,
            job_id TEXT NOT NULL REFERENCES jobs (job_id),
            worker TEXT NOT NULL,
            claim_id TEXT NOT NULL,
            attempt INTEGER NOT NULL
        )""",
        "CREATE INDEX leases_by_claim ON leases (worker, claim_id)",
    ),
    (
        # Small blobs stand beside the rows that brought them: one commit for both. What was a file stays one.
        "CREATE TABLE contents (sha256 TEXT NOT NULL PRIMARY KEY, content BLOB NOT NULL)",
        "ALTER TABLE blobs ADD COLUMN is_file INTEGER NOT NULL DEFAULT 1",
    ),
    (
        # Small blobs that come many together lie in packs: among the rows each is written twice.
        "ALTER TABLE blobs ADD COLUMN pack BIGINT NOT NULL DEFAULT 0",
        "ALTER TABLE blobs ADD COLUMN offset_bytes BIGINT NOT NULL DEFAULT 0",
    ),
    (
        # What a check verifies rows by, as `records.row_sha256`, which covers the references from here on. Rows that
        # were there before have none, until a job goes on.
        "ALTER TABLE jobs ADD COLUMN content_sha256 TEXT NOT NULL DEFAULT ''",
        "ALTER TABLE jobs ADD COLUMN progress_sha256 TEXT NOT NULL DEFAULT ''",
        "ALTER TABLE leases ADD COLUMN row_sha256 TEXT NOT NULL DEFAULT ''",
    ),
)
SCHEMA_VERSION = len(MIGRATIONS)
