-- Ends a planned sealing: enters the file into the index and removes its range from the log, or does neither.
--
-- The range of positions is the oldest that the log holds, without a hole. What it holds of a stream is entered in
-- ranges of sequences: one ends where the next events are not among them, or were taken before. The caller names for
-- each range the last sequence and the chain hash that it read back from the file. A chain hash stands for every byte of
-- the stream up to there, so a file that holds anything else does not get past this.
-- What the file holds without payload (p_hollow, positions) may have come back meanwhile; then it must be written anew.
-- Errors: VA006, nothing is removed.
create function seal_segments(
  p_path text, p_sha256 bytea, p_bytes bigint, p_station text[], p_epoch integer[], p_source text[], p_type text[],
  p_last_sequence bigint[], p_chain_hash bytea[], p_hollow bigint[]
) returns void
language plpgsql security definer set search_path from current as $$
declare
  head    archive_head;
  first   bigint;
  removed bigint;
begin
  select * into strict head from archive_head for update;
  if head.pending_path is distinct from p_path then
    raise exception 'no sealing of % is planned', p_path using errcode = 'VA006';
  end if;
  first := head.sealed_position + 1;
  if exists (select from segments where position = any(p_hollow) and payload is not null) then
    raise exception 'a payload that % lacks came back while it was written', p_path using errcode = 'VA006';
  end if;

  insert into sealed_files (first_position, last_position, path, sha256, bytes, segments, events, time_min, time_max)
    select first, head.pending_position, p_path, p_sha256, p_bytes, count(*), sum(g.event_count), min(g.time_min),
      max(g.time_max)
    from segments g where g.position between first and head.pending_position;
  insert into sealed_ranges (stream_id, first_sequence, last_sequence, file, first_position, last_position,
      time_min, time_max, chain_hash)
    select stream_id, min(first_sequence), max(last_sequence), first, min(position), max(position), min(time_min),
      max(time_max), (array_agg(chain_hash order by position desc))[1]
    from (
      select *, count(*) filter (where begins) over (partition by stream_id order by first_sequence) as range
      from (
        select g.stream_id, g.first_sequence, g.first_sequence + g.event_count - 1 as last_sequence, g.position,
          g.time_min, g.time_max, g.chain_hash,
          g.first_sequence <> lag(g.first_sequence + g.event_count) over by_sequence
            or g.position < lag(g.position) over by_sequence as begins
        from segments g where g.position between first and head.pending_position
        window by_sequence as (partition by g.stream_id order by g.first_sequence)
      ) as compared
    ) as numbered
    group by stream_id, range;

  if exists (
    (select s.station, s.epoch, s.source, s.type, r.last_sequence, r.chain_hash
       from sealed_ranges r join streams s on s.id = r.stream_id where r.file = first
     except all select * from unnest(p_station, p_epoch, p_source, p_type, p_last_sequence, p_chain_hash))
    union all
    (select * from unnest(p_station, p_epoch, p_source, p_type, p_last_sequence, p_chain_hash)
     except all select s.station, s.epoch, s.source, s.type, r.last_sequence, r.chain_hash
       from sealed_ranges r join streams s on s.id = r.stream_id where r.file = first)
  ) then
    raise exception 'what was read back from % is not what the log holds', p_path using errcode = 'VA006';
  end if;

  update archive_head set is_removing = true;
  delete from segments where position between first and head.pending_position;
  get diagnostics removed = row_count;
  if removed <> head.pending_position - head.sealed_position then
    raise exception 'positions % to % have holes', first, head.pending_position using errcode = 'VA006';
  end if;
  update archive_head set is_removing = false, sealed_position = head.pending_position, pending_path = null,
    pending_position = null;
end $$;
